#!/usr/bin/env bash
# Sets up, then benchmarks a robot among pedestrians: bson demo. Arguments go to it (bson demo --help).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
tools/setup.sh
if ! [ -w . ] && ! [[ " $* " =~ \ --o(u|ut)?[\ =] ]]; then
  echo "demo: can't write results to $PWD: name a folder that you can write to, e.g. tools/demo.sh --out ~/bson-demo" >&2
  exit 1
fi
exec .venv/bin/bson demo "$@"
