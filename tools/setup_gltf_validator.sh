#!/usr/bin/env bash
# Installs Khronos' glTF validator for the tests of mesh files (they are skipped without it). Needs Node.js and npm.
set -euo pipefail
cd "$(dirname "$0")/gltf"

say() { printf 'setup_gltf_validator: %s\n' "$*"; }

if [[ -d node_modules/gltf-validator ]]; then
    say "it is here; nothing to do"
    exit 0
fi
command -v npm >/dev/null || {
    say "there is no npm; install Node.js 18 or later by the means of your distribution"
    exit 1
}
npm install --no-package-lock --no-audit --no-fund --silent
say "done"
