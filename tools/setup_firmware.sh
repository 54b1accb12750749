#!/usr/bin/env bash
# Build the images of the reference firmware into build/firmware/images, for the tests that run them
# on emulated microcontrollers. Without them those tests skip.
set -euo pipefail
cd "$(dirname "$0")/.."
say() { printf 'setup: %s\n' "$*" >&2; }

packages="gcc libc6-dev make simavr libsimavr-dev libelf-dev gcc-avr avr-libc binutils-avr
  qemu-system-arm gcc-arm-none-eabi libnewlib-arm-none-eabi"
if ! command -v avr-gcc >/dev/null 2>&1 || ! command -v qemu-system-arm >/dev/null 2>&1 ||
  ! command -v arm-none-eabi-gcc >/dev/null 2>&1 || ! [ -e /usr/include/simavr/sim_avr.h ]; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    say "installing compilers and emulators of microcontrollers through apt (about a minute)"
    # shellcheck disable=SC2086
    apt-get install -y -qq --no-install-recommends $packages >/dev/null 2>&1 ||
      { apt-get update -qq >/dev/null 2>&1 &&
        apt-get install -y -qq --no-install-recommends $packages >/dev/null 2>&1; } ||
      { say "apt could not install them"; exit 1; }
  else
    say "compilers are missing. Type this, then try again:  sudo apt-get install" $packages
    exit 1
  fi
fi
make -s -C firmware
say "done: REQUIRE_FIRMWARE=1 makes an absent image a failure"
