#!/usr/bin/env bash
# Set up .venv in this clone: `setup.sh` for the command, `setup.sh tests` for the tests and the lint as well,
# `setup.sh docs` for the documentation as well, `setup.sh offline` for the compilation of kernels for GPUs as well.
# It changes only .venv; as root it also installs missing Debian packages.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

say() { echo "setup: $*"; }
fail() { echo "setup: $*" >&2; exit 1; }

# Print the first Python on PATH that runs, is new enough, and has the given modules. The first Python on PATH may be
# too old, or in a folder that this user cannot read.
find_python() {
  local name path
  for name in python3 python3.{14,13,12,11}; do
    for path in $(type -ap "$name"); do
      if "$path" -c "import sys${1:+, $1}; sys.exit(sys.version_info < (3, 11))" 2>/dev/null; then
        echo "$path"
        return
      fi
    done
  done
  return 1
}

may_apt() { [ "$(id -u)" = 0 ] && type -P apt-get >/dev/null; }

apt_install() {
  say "apt-get install $*"
  local install=(apt-get -qq -y --no-install-recommends install "$@")
  export DEBIAN_FRONTEND=noninteractive
  # The package lists of a fresh machine or image are empty or old: fetched only if it does not work without.
  "${install[@]}" >/dev/null 2>&1 </dev/null || { apt-get -qq update && "${install[@]}" >/dev/null; } </dev/null
}

make_environment() {
  .venv/bin/python -m pip --version >/dev/null 2>&1 && return
  local python
  if ! python=$(find_python ensurepip) && may_apt; then
    apt_install python3 python3-venv || true
    python=$(find_python ensurepip) || true
  fi
  if [ -n "$python" ]; then
    say "virtual environment .venv of $python"
    "$python" -m venv --clear .venv
  elif python=$(find_python pip); then # Debian's python3-pip without python3-venv
    say "virtual environment .venv of $python, with its own pip"
    "$python" -m venv --clear --without-pip .venv
    "$python" -m pip --quiet --python .venv/bin/python install pip
  elif python=$(find_python); then
    fail "$python cannot make a virtual environment; have root run: apt-get install python3-venv"
  else
    fail "no Python 3.11 or newer on PATH; have root run: apt-get install python3.11-venv (or a later one)"
  fi
}

install() {
  say "pip install $1"
  .venv/bin/python -m pip -qq --disable-pip-version-check --no-input install --editable "$1"
}

device_works() { .venv/bin/gpuvision devices --probe >/dev/null 2>&1; }

ensure_device() {
  device_works && return
  if may_apt && apt_install pocl-opencl-icd && device_works; then return; fi
  install ".[cpu]"
  device_works && return
  .venv/bin/gpuvision devices >&2 || true
  fail "no OpenCL device works on this machine; what to install is said above"
}

case "${1:-}" in
  "")
    make_environment
    install .
    ensure_device
    ;;
  tests) install ".[test,cpu,profile]" ;; # both CPU runtimes are tested where both can run; benchmarks too
  docs | offline) install ".[$1]" ;;
  *) fail "expected no argument, 'tests', 'docs' or 'offline', got '$1'" ;;
esac
