#!/usr/bin/env bash
# Makes .venv in the checkout with everything that the project needs. Safe to run again; quick when nothing changed.
# PYTHON=... chooses the interpreter (3.11 or newer), EXTRAS=... pyproject.toml's extras (test; test,agents has torch).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
extras=${EXTRAS:-test}

find_python() {
  for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python}; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      echo "$candidate"
      return
    fi
  done
  echo "setup: no Python 3.11 or newer found; install one, or name it with PYTHON=/path/to/python3" >&2
  exit 1
}

# Everything is made in the checkout, so it has to be one that can be written.
check_writable() {
  if ! { : > .setup-try; } 2>/dev/null; then
    echo "setup: can't write to $PWD, where .venv is to be made: copy the checkout to a folder of yours (cp -r $PWD ~/bson)" \
      "and run the copy's tools/, or install into an environment of your own: python3 -m venv ~/bson-env &&" \
      "~/bson-env/bin/pip install $PWD && ~/bson-env/bin/bson demo --out ~/bson-demo" >&2
    exit 1
  fi
  rm -f .setup-try
}

install_packages() {
  local stamp want
  stamp=.venv/.setup-stamp
  want=$( (echo "$extras"; cat pyproject.toml tools/constraints.txt) | sha256sum)
  if [ -x .venv/bin/python ] && [ "$(cat "$stamp" 2>/dev/null)" = "$want" ]; then
    return
  fi
  check_writable
  if [ ! -x .venv/bin/python ]; then
    local python
    python=$(find_python)
    echo "setup: making .venv with $("$python" --version)" >&2
    "$python" -m venv .venv || {
      echo "setup: '$python -m venv' failed; on Debian: apt-get install python3-venv" >&2
      exit 1
    }
  fi
  echo "setup: installing packages [$extras] into .venv (about 1 GB on disk, 2 GB with agents)" >&2
  .venv/bin/python -m pip install --quiet --disable-pip-version-check -c tools/constraints.txt -e ".[$extras]" >&2
  echo "$want" > "$stamp"
}

has_egl() {
  MUJOCO_GL=egl .venv/bin/python -c 'import mujoco; mujoco.GLContext(8, 8)' >/dev/null 2>&1
}

# Pictures need EGL: Mesa's software driver will do. Without it everything else still works.
install_egl() {
  if has_egl; then
    return
  fi
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "setup: installing Mesa's EGL for offscreen pictures" >&2
    if (apt-get update -qq && apt-get install -y -qq --no-install-recommends libegl1 libgl1-mesa-dri) >/dev/null 2>&1 &&
      has_egl; then
      return
    fi
  fi
  echo "setup: no EGL, so no pictures or videos; install it with: sudo apt-get install libegl1 libgl1-mesa-dri" >&2
}

install_packages
install_egl
