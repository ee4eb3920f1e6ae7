#!/usr/bin/env bash
# Sets up, then benchmarks a robot among pedestrians: bson demo. Arguments go to it (bson demo --help).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
tools/setup.sh
exec .venv/bin/bson demo "$@"
