#!/bin/bash
# A full disk, and one that cannot be written. Needs the right to mount a tmpfs; says so where it is missing.
. "$(dirname "$0")/lib.sh"
disk=$work/disk
mkdir "$disk"
mount -t tmpfs -o size=64k tmpfs "$disk" 2>/dev/null || { echo "skipped: a tmpfs cannot be mounted here"; exit 77; }
trap 'umount "$disk"; rm -rf "$work"' EXIT
train=(train "$source_dir/assets/demo_free_30" -o "$disk/run" --joints 3 --bending planar --frames 0:6)

run "${train[@]}"
expect_code 1 'a full disk'
[ "$(grep -c '^chainsplat: error: .*No space left.*; .*--resume' "$work/stderr")" -eq 1 ] || fail 'a full disk: no error line that says how to go on'
find "$disk" -name '*.tmp*' | grep -q . && fail 'a full disk: a half-written file is left'
mount -o remount,size=64m "$disk"
run "${train[@]}" --resume
expect_code 0 'after room was made'
[ -s "$disk/run/metrics.json" ] || fail 'after room was made: no metrics'

mount -o remount,ro "$disk"
expect_error 2 'cannot be made in' train "$source_dir/assets/demo_free_30" -o "$disk/other" --frames 0:6
expect_error 2 'cannot be' "${train[@]}" --resume
finish
