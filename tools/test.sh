#!/usr/bin/env bash
# Sets up, then runs the whole test suite, a file at a time on each core. Arguments go to pytest (-m slow runs the long
# checks alone, -n 0 runs one test after the other in this process). EXTRAS=test,agents
# installs torch and stable-baselines3 too, without which their tests are skipped.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
tools/setup.sh
exec .venv/bin/python -m pytest -n auto --dist loadfile "$@"
