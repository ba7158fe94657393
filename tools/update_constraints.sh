#!/usr/bin/env bash
# Resolve pyproject.toml again for every supported Python and write constraints.txt. Needs uv.
set -euo pipefail
cd "$(dirname "$0")/.."
pins=$(mktemp)
trap 'rm -f "$pins"' EXIT
printf 'torch==2.13.0\nsetuptools<81\n' >"$pins"
{
  echo "# Versions that were tested together, for Python 3.10 and newer; made by tools/update_constraints.sh."
  echo "# torch is pinned because an open range fetches gigabytes of CUDA packages; GPU users leave this line out and choose theirs."
  uv pip compile pyproject.toml --extra dev --universal --python-version 3.10 --no-header --no-annotate -q -c "$pins" |
    grep -v -i -E '^(nvidia-(cu|nc|nv)|cuda-|triton)'
} >constraints.txt.new
mv constraints.txt.new constraints.txt
