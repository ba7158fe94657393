#!/usr/bin/env bash
# Makes SAPIEN able to render on this machine: a Vulkan driver (Mesa >= 24.3 where there is no GPU).
#
#   tools/setup_system.sh                    install what is missing; says so and does nothing when all is there
#   tools/setup_system.sh --check            only say what is there and what would be done; exit 1 if something is missing
#   tools/setup_system.sh --print-backports DIR [CODENAME]
#                                            print the apt source that would be added, derived from DIR (like /etc/apt)
#
# Where it may not install (no root and no passwordless sudo), it prints the exact command and exits 0, because
# everything but pictures works without a Vulkan driver: reconstruction, physics and observations of mode "state".
# No host name is written here: backports come from the same mirror that the machine already uses.
set -euo pipefail

# Lavapipe has VK_KHR_external_memory_fd and VK_KHR_external_semaphore_fd, which SAPIEN needs, from this version on.
NEEDED_MESA_MAJOR=24
NEEDED_MESA_MINOR=3
PACKAGES=(mesa-vulkan-drivers libvulkan1)
ADDED_NAME=simrecon-backports

say() { printf 'setup_system: %s\n' "$*"; }

# --- what is there ----------------------------------------------------------------------------------------------

installed_version() { # installed_version PACKAGE -> its version, or nothing
    dpkg-query -W -f '${db:Status-Abbrev}${Version}\n' "$1" 2>/dev/null | sed -n '/^ii/{s/^ii *//p;q}' || true
}

candidate_version() { # candidate_version PACKAGE -> the version that apt would install, or nothing
    apt-cache policy "$1" 2>/dev/null | sed -n 's/^ *Candidate: *//p' | { grep -v '(none)' || true; }
}

new_enough() { # new_enough VERSION: is this Mesa version (1:24.3.0-2 …) at least the needed one?
    local version=${1#*:} major minor
    major=${version%%.*}
    minor=${version#*.}
    minor=${minor%%[!0-9]*}
    [[ $major =~ ^[0-9]+$ && $minor =~ ^[0-9]+$ ]] || return 1
    ((major > NEEDED_MESA_MAJOR || (major == NEEDED_MESA_MAJOR && minor >= NEEDED_MESA_MINOR)))
}

has_nvidia_vulkan() { # an NVIDIA GPU whose driver brings a Vulkan driver
    { [[ -e /dev/nvidia0 ]] || [[ -e /dev/dxg ]]; } || return 1
    compgen -G '/usr/share/vulkan/icd.d/nvidia*.json' >/dev/null ||
        compgen -G '/etc/vulkan/icd.d/nvidia*.json' >/dev/null
}

has_vulkan_loader() {
    local paths
    paths=$(ldconfig -p 2>/dev/null || /sbin/ldconfig -p 2>/dev/null || true)
    [[ $paths == *libvulkan.so.1* ]]
}

# --- deriving the backports source ------------------------------------------------------------------------------

# Prints, for every enabled apt source of suite CODENAME with component main, the same source with suite
# CODENAME-backports: a deb822 stanza (Signed-By and the like are kept), or a classic `deb` line.
# Prints "present" alone when some source already has the suite.
derive_backports() { # derive_backports APT_DIR CODENAME
    local dir=$1 codename=$2 files=() file
    for file in "$dir"/sources.list.d/*.sources "$dir"/sources.list "$dir"/sources.list.d/*.list; do
        [[ -f $file ]] && files+=("$file")
    done
    ((${#files[@]})) || return 0
    awk -v codename="$codename" '
        function has_word(text, word,    parts, n, i) {
            n = split(text, parts, /[ \t]+/)
            for (i = 1; i <= n; i++) if (parts[i] == word) return 1
            return 0
        }
        function end_of_stanza() {
            if (stanza != "" && enabled && has_word(types, "deb")) {
                if (has_word(suites, codename "-backports")) present = 1
                if (has_word(suites, codename) && has_word(components, "main") && deb822 == "") deb822 = stanza
            }
            stanza = ""; types = ""; suites = ""; components = ""; enabled = 1; field = ""
        }
        FNR == 1 { end_of_stanza(); is_deb822 = (FILENAME ~ /\.sources$/) }
        is_deb822 && /^[ \t]*$/ { end_of_stanza(); next }
        is_deb822 && /^#/ { next }
        is_deb822 {
            if ($0 !~ /^[ \t]/) { field = tolower($0); sub(/[ \t]*:.*/, "", field) }
            value = $0
            sub(/^[^:]*:[ \t]*/, "", value)
            if ($0 ~ /^[ \t]/) value = $0
            if (field == "types") types = types " " value
            if (field == "suites") { suites = suites " " value }
            if (field == "components") { components = components " " value }
            if (field == "enabled" && tolower(value) ~ /^(no|false|off|0)/) enabled = 0
            # The suite and components are written anew; a pinned snapshot or options stay as they are.
            if (field == "types") { if ($0 !~ /^[ \t]/) stanza = stanza "Types: deb\n" }
            else if (field == "suites") { if ($0 !~ /^[ \t]/) stanza = stanza "Suites: " codename "-backports\n" }
            else if (field == "components") { if ($0 !~ /^[ \t]/) stanza = stanza "Components: main\n" }
            else stanza = stanza $0 "\n"
            next
        }
        /^[ \t]*deb[ \t]/ {
            line = $0
            sub(/#.*/, "", line); sub(/^[ \t]*deb[ \t]+/, "", line)
            options = ""
            if (line ~ /^\[/) { options = line; sub(/\].*/, "] ", options); sub(/^[^\]]*\][ \t]*/, "", line) }
            n = split(line, parts, /[ \t]+/)
            if (parts[2] == codename "-backports") present = 1
            for (i = 3; i <= n; i++)
                if (parts[2] == codename && parts[i] == "main" && classic == "")
                    classic = "deb " options parts[1] " " codename "-backports main\n"
        }
        END {
            end_of_stanza()
            if (present) print "present"
            else if (deb822 != "") printf "%s", deb822
            else printf "%s", classic
        }
    ' "${files[@]}"
}

# --- installing -------------------------------------------------------------------------------------------------

as_root() {
    if ((EUID == 0)); then "$@"; else sudo -n "$@"; fi
}

may_install() {
    ((EUID == 0)) && return 0
    command -v sudo >/dev/null && sudo -n true 2>/dev/null
}

apt_quiet() {
    as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -o Dpkg::Use-Pty=0 "$@"
}

cannot_install() { # cannot_install COMMAND...: print what a person must do, and go on
    say "rendering needs a newer Vulkan driver, which this account may not install. As root, run:"
    printf '\n    %s\n\n' "$@"
    say "without it everything but pictures works (obs_mode=\"state\", physics, reconstruction)"
}

install_packages() { # install_packages [TARGET_SUITE]
    local target=()
    [[ -n ${1:-} ]] && target=(-t "$1")
    say "installing ${PACKAGES[*]}${1:+ from $1}"
    apt_quiet install -y --no-install-recommends "${target[@]}" "${PACKAGES[@]}" >/dev/null
}

setup_debian_12() {
    local source
    source=$(derive_backports /etc/apt bookworm)
    if [[ -z $source ]]; then
        say "no apt source of suite bookworm was found; add bookworm-backports by hand, then run this again"
        return
    fi
    if ! may_install; then
        cannot_install "bash $(readlink -f "$0")"
        return
    fi
    if [[ $source != present ]]; then
        local extension=list
        [[ $source == deb\ * ]] || extension=sources
        say "adding suite bookworm-backports as /etc/apt/sources.list.d/$ADDED_NAME.$extension"
        printf '# Added by tools/setup_system.sh of SimRecon, for a Mesa that SAPIEN can render with.\n%s\n' "$source" |
            as_root tee "/etc/apt/sources.list.d/$ADDED_NAME.$extension" >/dev/null
    fi
    apt_quiet update || say "apt-get update had errors (shown above)"
    local policy # in a variable, because `grep -q` would break the pipe and pipefail would see that as "no"
    policy=$(apt-cache policy mesa-vulkan-drivers)
    if [[ $policy != *bookworm-backports* ]]; then
        say "this machine's mirror has no usable bookworm-backports; rendering stays off"
        [[ $source != present ]] && as_root rm -f "/etc/apt/sources.list.d/$ADDED_NAME".{list,sources}
        return
    fi
    install_packages bookworm-backports || say "apt-get could not install (shown above)"
}

setup_apt() { # Debian 13+, Ubuntu, and their relatives
    if ! may_install; then
        cannot_install "apt-get update && apt-get install -y --no-install-recommends ${PACKAGES[*]}"
        return
    fi
    apt_quiet update || say "apt-get update had errors (shown above)"
    local candidate
    candidate=$(candidate_version mesa-vulkan-drivers)
    if [[ -z $candidate ]]; then
        say "apt knows no mesa-vulkan-drivers here; install a Vulkan driver by the means of your distribution"
        return
    fi
    install_packages || say "apt-get could not install (shown above)"
}

explain_old_mesa() { # explain_old_mesa DISTRIBUTION VERSION
    say "Mesa ${2:-(none)} of $1 is too old for SAPIEN without a GPU (needs >= $NEEDED_MESA_MAJOR.$NEEDED_MESA_MINOR)"
    if [[ $1 == ubuntu* ]]; then
        say "the PPA 'kisak' has a newer one; it replaces the Mesa of the whole system, so decide yourself:"
        printf '\n    %s\n    %s\n    %s\n\n' "sudo apt-get install -y software-properties-common" \
            "sudo add-apt-repository -y ppa:kisak/kisak-mesa" \
            "sudo apt-get install -y --no-install-recommends ${PACKAGES[*]}"
        say "or, without touching the system, conda's: conda create -y -p ~/lavapipe -c conda-forge mesa-lavapipe"
        printf '\n    %s\n\n' "export VK_ICD_FILENAMES=\$(ls ~/lavapipe/share/vulkan/icd.d/lvp_icd*.json)"
    fi
    say "without it everything but pictures works (obs_mode=\"state\", physics, reconstruction)"
}

# --- main -------------------------------------------------------------------------------------------------------

ready() { # is there a Vulkan driver that SAPIEN can render with, as far as packages tell?
    if has_nvidia_vulkan; then
        has_vulkan_loader || return 1
        say "an NVIDIA GPU with a Vulkan driver is here; nothing to do"
        return 0
    fi
    if [[ -n ${VK_ICD_FILENAMES:-${VK_DRIVER_FILES:-}} ]]; then
        say "VK_ICD_FILENAMES or VK_DRIVER_FILES names the Vulkan driver; nothing to do ('simrecon doctor' tests it)"
        return 0
    fi
    command -v dpkg-query >/dev/null || return 1
    local mesa
    mesa=$(installed_version mesa-vulkan-drivers)
    [[ -n $mesa ]] && new_enough "$mesa" && [[ -n $(installed_version libvulkan1) ]] || return 1
    say "Mesa $mesa and the Vulkan loader are here; nothing to do"
}

main() {
    if [[ ${1:-} == --print-backports ]]; then
        derive_backports "${2:?a folder like /etc/apt}" "${3:-bookworm}"
        return
    fi
    if ready; then return 0; fi
    local mesa=""
    command -v dpkg-query >/dev/null && mesa=$(installed_version mesa-vulkan-drivers)
    if [[ ${1:-} == --check ]]; then
        say "a Vulkan driver that SAPIEN can render with is missing (Mesa here: ${mesa:-none}, needed:" \
            ">= $NEEDED_MESA_MAJOR.$NEEDED_MESA_MINOR); run tools/setup_system.sh"
        return 1
    fi
    local ID="" ID_LIKE="" VERSION_ID="" VERSION_CODENAME=""
    # shellcheck disable=SC1091
    [[ -r /etc/os-release ]] && . /etc/os-release
    case "$(uname -s)/$ID/${VERSION_CODENAME:-}" in
        Darwin/*)
            say "on macOS SAPIEN renders through MoltenVK, which its wheel brings; nothing to install"
            ;;
        Linux/debian/bookworm) setup_debian_12 ;;
        Linux/debian/* | Linux/ubuntu/* | Linux/linuxmint/* | Linux/pop/*) setup_apt ;;
        Linux/*)
            if [[ " $ID_LIKE " == *" debian "* || " $ID_LIKE " == *" ubuntu "* ]]; then
                setup_apt
            else
                say "unknown distribution '${ID:-?}': install the Vulkan loader (libvulkan.so.1) and Mesa's Vulkan" \
                    "drivers >= $NEEDED_MESA_MAJOR.$NEEDED_MESA_MINOR (packages vulkan-loader and" \
                    "mesa-vulkan-drivers on Fedora, vulkan-icd-loader and vulkan-swrast on Arch)"
            fi
            ;;
        *) say "this system is not supported; SAPIEN has wheels for Linux and macOS" ;;
    esac
    [[ $(uname -s) == Linux ]] && command -v dpkg-query >/dev/null || return 0
    if has_nvidia_vulkan; then return 0; fi
    mesa=$(installed_version mesa-vulkan-drivers)
    if [[ -n $mesa ]] && new_enough "$mesa"; then
        say "done: Mesa $mesa"
    elif may_install; then
        explain_old_mesa "$ID $VERSION_ID" "$mesa"
    elif [[ $ID == ubuntu ]] && ! new_enough "$(candidate_version mesa-vulkan-drivers)"; then
        explain_old_mesa "$ID $VERSION_ID" "$(candidate_version mesa-vulkan-drivers)"
    fi
}

main "$@"
