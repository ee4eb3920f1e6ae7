#!/usr/bin/env bash
# The gates before the tests: ruff's rules and pyright's types (basedpyright: the same, in a wheel that fetches nothing).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
EXTRAS=${EXTRAS:-test,agents,lint} tools/setup.sh
.venv/bin/ruff check bson macid tests tools
.venv/bin/basedpyright --project pyproject.toml
