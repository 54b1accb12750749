#!/usr/bin/env bash
# Make .venv with everything that `make demo` and `make test` need, and say what is done.
# With the word `demo`, make what the demo's first rig needs and no more: it starts sooner.
# Runs again only when pyproject.toml or constraints.txt changed. SKINRIG_EXTRAS=dev,docs installs other extras
# than dev; SKINRIG_NO_KERNELS=1 compiles nothing ahead.
set -euo pipefail
cd "$(dirname "$0")/.."
scope=${1:-all}
say() { printf 'setup: %s\n' "$*" >&2; }

python=${PYTHON:-}
if [ -z "$python" ]; then
  for candidate in python3 python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null 2>&1 &&
       "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      python=$candidate
      break
    fi
  done
fi
if [ -z "$python" ]; then
  say "no Python 3.11 or newer was found; install one, for example: apt-get install python3"
  exit 1
fi

is_root_with_apt() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; }

apt_install() {
  apt-get install -y -qq --no-install-recommends "$@" >/dev/null 2>&1 ||
    { apt-get update -qq >/dev/null 2>&1 &&
      apt-get install -y -qq --no-install-recommends "$@" >/dev/null 2>&1; }
}

if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
  if is_root_with_apt; then
    say "this Python has no ensurepip: installing Debian's python3-venv through apt"
    apt_install python3-venv || { say "apt could not install python3-venv"; exit 1; }
  else
    say "this Python has no ensurepip. Type this, then try again:  sudo apt-get install python3-venv"
    exit 1
  fi
fi

# Mitsuba compiles with LLVM where it finds version 17 or newer; 14 is refused and
# 15 and 16 abort the process, so a present but old LLVM does not count.
has_good_llvm() {
  local library
  for library in /usr/lib/*/libLLVM.so.1[789]* /usr/lib/*/libLLVM.so.2* \
                 /usr/lib/*/libLLVM-1[789].so* /usr/lib/*/libLLVM-2*.so* \
                 /usr/lib64/libLLVM.so.1[789]* /usr/lib64/libLLVM.so.2*; do
    [ -e "$library" ] && return 0
  done
  return 1
}
if ! has_good_llvm; then
  if is_root_with_apt && [ "${SKINRIG_NO_APT:-}" = "" ]; then
    say "no LLVM 17 or newer: installing Debian's libllvm19 through apt (Mitsuba renders faster with it)"
    apt_install libllvm19 ||
      say "libllvm19 could not be installed: rendering falls back to the slower scalar variants"
  else
    say "no LLVM 17 or newer: rendering uses the slower scalar variants (faster: apt-get install libllvm19)"
  fi
fi

if [ ! -x .venv/bin/python ]; then
  say "creating .venv with $("$python" --version)"
  "$python" -m venv .venv
fi
case $scope in
  demo) extras='' compile_for=(--rig flash) ;;
  *) extras="[${SKINRIG_EXTRAS:-dev}]" compile_for=() ;;
esac
say "installing skinrig and its pinned dependencies into .venv (about a minute)"
# a build environment made from the same pinned list, so that nothing unpinned runs; Python compiles
# a module when it is first imported, which most of them never are
pip_install() {
  .venv/bin/python -m pip install -q --no-compile --disable-pip-version-check -c constraints.txt "$@" \
    2> >(grep -v '^WARNING' >&2 || true)
}
pip_install setuptools wheel
pip_install --no-build-isolation -e ".$extras"
if [ "${SKINRIG_NO_KERNELS:-}" = "" ]; then
  say "compiling kernels that the demo calls (one to three minutes on two cores; else the first call does it)"
  .venv/bin/python tools/compile_kernels.py ${compile_for[@]+"${compile_for[@]}"} ||
    say "the kernels could not be compiled ahead: each is compiled when it is first called"
fi
touch .venv/.demo
[ "$scope" = demo ] || touch .venv/.ready
say "done: .venv/bin/skinrig is installed"
