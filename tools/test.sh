#!/usr/bin/env bash
# Sets up, then runs the whole test suite. Arguments go to pytest (-m slow runs the long checks alone). EXTRAS=test,agents
# installs torch and stable-baselines3 too, without which their tests are skipped.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
tools/setup.sh
exec .venv/bin/python -m pytest "$@"
