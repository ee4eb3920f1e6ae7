#!/usr/bin/env bash
# Builds the pages and the API's documentation, with pdoc, into a folder: tools/docs.sh [FOLDER] (default: docs). Sets up first.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
EXTRAS=${EXTRAS:-test,agents,docs} tools/setup.sh
exec .venv/bin/python tools/make_docs.py "${1:-docs}"
