#!/usr/bin/env bash
# Sets up, then runs the whole test suite. Arguments go to pytest (-m slow runs the long checks alone).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
tools/setup.sh
exec .venv/bin/python -m pytest "$@"
