#!/usr/bin/env bash
# A real PDAL for the tests, where nobody installed one: Debian bullseye, the last Debian with the command `pdal`,
# in a folder of its own, from the mirror that apt is set up with. Needs root.
# Prints a command for fetch.prepare.pdal_command, or why there is none.
# tests/pdal/make_root.sh [FOLDER]      default: ~/.cache/p2wss-test/bullseye-pdal (450 MB, about a minute)
set -euo pipefail
PATH=$PATH:/usr/sbin:/sbin  # chroot
root=${1:-${XDG_CACHE_HOME:-$HOME/.cache}/p2wss-test/bullseye-pdal}
skip() { echo "no PDAL for the tests: $*" >&2; exit 3; }

mkdir -p "$(dirname "$root")"
exec 9>"$root.lock"  # two test runs at once make it once
flock 9
if [ ! -x "$root/usr/bin/pdal" ]; then
    [ "$(id -u)" = 0 ] || skip "making a root needs the user root"
    command -v apt-get >/dev/null || skip "this is no Debian"
    command -v debootstrap >/dev/null || timeout 60 apt-get install -qq -y debootstrap >/dev/null 2>&1 \
        || skip "debootstrap is not installed, and apt cannot install it"
    mirror=$(apt-get indextargets --format '$(ORIGIN) $(LABEL) $(REPO_URI)' | sed -n 's/^Debian Debian //p' | head -1)
    # before the first apt-get update only the addresses are known
    [ -n "$mirror" ] || mirror=$(apt-get indextargets --no-release-info --format '$(SITE)' | grep '/debian/*$' | head -1)
    [ -n "$mirror" ] || skip "apt knows no Debian mirror"
    mkdir -p "$root.new.$$"
    trap 'umount -q "$root.new.$$/proc" "$root.new.$$/sys" 2>/dev/null; rm -rf --one-file-system "$root.new.$$"' EXIT
    timeout "${P2WSS_PDAL_TIMEOUT_S:-180}" debootstrap --variant=minbase --include=pdal bullseye "$root.new.$$" "$mirror" >"$root.log" 2>&1 \
        || skip "debootstrap failed; see $root.log"
    rm -rf "$root"
    mv "$root.new.$$" "$root"
fi
chroot "$root" pdal --version >/dev/null 2>&1 || skip "$root: pdal does not start there"
echo "$(cd "$(dirname "$0")" && pwd)/pdal.sh $root"
