#!/usr/bin/env bash
# Installs Chromium for the tests that open the report page in a real browser (pytest -m browser).
#
#   tools/setup_browser.sh            install it where it is missing; exit 1 with the reason where that is not possible
#   tools/setup_browser.sh --check    only say whether it is there
#
# Packages come from what this machine's apt is set up with; no host name is written here. Everything but these tests
# works without a browser.
set -euo pipefail

say() { printf 'setup_browser: %s\n' "$*"; }

for name in chromium chromium-browser google-chrome google-chrome-stable; do
    if command -v "$name" >/dev/null; then
        say "$(command -v "$name") is here; nothing to do"
        exit 0
    fi
done
if [[ ${1:-} == --check ]]; then
    say "there is no Chromium here; run tools/setup_browser.sh"
    exit 1
fi
if ! command -v apt-get >/dev/null; then
    say "this machine has no apt-get; install Chromium by the means of your distribution"
    exit 1
fi
if ((EUID == 0)); then
    as_root=()
elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root=(sudo -n)
else
    say "installing needs root. As root, run:"
    printf '\n    %s\n\n' "apt-get update && apt-get install -y --no-install-recommends chromium"
    exit 1
fi
apt_quiet() { "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -qq -o Dpkg::Use-Pty=0 "$@"; }
apt_quiet update || say "apt-get update had errors (shown above)"
say "installing chromium and a font"
apt_quiet install -y --no-install-recommends chromium fonts-dejavu-core >/dev/null
command -v chromium >/dev/null || command -v chromium-browser >/dev/null || {
    say "apt-get installed no chromium (Ubuntu's is a snap); install a Chromium or Chrome yourself"
    exit 1
}
say "done"
