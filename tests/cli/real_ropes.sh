#!/bin/bash
# tools/real_ropes runs, and its chain agrees with the measured steel strip and cables. Skipped (77) without the data,
# which stay out of the repository: CHAINSPLAT_REAL_DATA names their folder.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
if [ -z "${CHAINSPLAT_REAL_DATA:-}" ] || [ ! -d "$CHAINSPLAT_REAL_DATA/beam_wrench" ] || ! command -v python3 >/dev/null
then
  echo 'skipped: no CHAINSPLAT_REAL_DATA'
  exit 77
fi
"$source_dir/tools/real_ropes" "$CHAINSPLAT_REAL_DATA" --program "$program" --only beam,cable >"$work/stdout" 2>"$work/stderr"
code=$?
expect_code 0 real_ropes
cat "$work/stdout"
awk -F'|' '/^\| (horizontal|pointing)/ { n += 1; d = $6 + 0; bad += d > 1 || d < -1 } END { exit !(n >= 9 && bad == 0) }' \
  "$work/stdout" || fail 'the first bending frequency is off by more than 1 %'
awk -F'|' '/^\| DLO/ { n += 1; bad += $9 > 1.2 } END { exit !(n == 3 && bad == 0) }' "$work/stdout" ||
  fail 'a shape fit is more than 1.2 times its floor'
finish
