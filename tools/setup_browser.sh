#!/usr/bin/env bash
# Add to .venv and node_modules what the tests in a browser and of exports use beside the rest:
# Chromium, playwright, axe-core, usd-core, the glTF validator and glTF Transform. Without them those tests skip.
set -euo pipefail
cd "$(dirname "$0")/.."
say() { printf 'setup: %s\n' "$*" >&2; }

if ! command -v chromium >/dev/null 2>&1; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    say "installing Debian's chromium through apt (about a minute)"
    apt-get install -y -qq --no-install-recommends chromium >/dev/null 2>&1 ||
      { apt-get update -qq >/dev/null 2>&1 &&
        apt-get install -y -qq --no-install-recommends chromium >/dev/null 2>&1; } ||
      { say "apt could not install chromium"; exit 1; }
  else
    say "no chromium was found. Type this, then try again:  sudo apt-get install chromium"
    exit 1
  fi
fi
say "installing playwright and usd-core into .venv"
.venv/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt \
  playwright usd-core 2> >(grep -v '^WARNING' >&2 || true)
if command -v npm >/dev/null 2>&1; then
  say "installing axe-core, gltf-validator and gltf-transform into node_modules"
  npm install --silent --no-save --no-package-lock --no-audit --no-fund \
    axe-core@4.14.1 gltf-validator@2.0.0-dev.3.10 \
    @gltf-transform/core@4.2.1 @gltf-transform/extensions@4.2.1 >/dev/null 2>&1 ||
    say "npm could not install them: the tests that use them skip"
else
  say "no npm: the tests that use axe-core, gltf-validator and gltf-transform skip"
fi
touch .venv/.browser
say "done: REQUIRE_BROWSER=1 makes an absent browser a failure"
