#!/usr/bin/env bash
# `pdal` as if it were installed: runs the one of make_root.sh on a copy of the current folder.
# tests/pdal/pdal.sh ROOT pdal-arguments..
set -euo pipefail
PATH=$PATH:/usr/sbin:/sbin  # chroot
root=$1
shift
work=$(mktemp -d "$root/tmp/work.XXXXXX")
trap 'rm -rf --one-file-system "$work"' EXIT
cp -r --preserve=timestamps . "$work"
status=0
chroot "$root" sh -c 'cd "$0" && exec pdal "$@"' "${work#"$root"}" "$@" || status=$?
cp -r --preserve=timestamps "$work/." .
exit $status
