#!/bin/bash
# Modules include only what is below them: reads all #include "chainsplat/..." lines and compares them with this table.
# A module may include those in its row, and what those may include.
cd "$(dirname "$0")/.." || exit 1
declare -A may=(
  [core]="" [math]="core" [solve]="math" [gpu]="core" [chain]="math" [trajectory]="math"
  [capture]="chain trajectory" [silhouette]="capture solve" [masking]="silhouette" [splat]="capture gpu" [dynamics]="chain trajectory solve"
  [recognition]="silhouette splat" [identification]="dynamics" [twin]="splat dynamics" [render]="twin"
  [refinement]="recognition identification" [eval]="render capture" [export]="render capture" [synth]="render capture"
  [estimation]="render silhouette" [force]="twin" [planning]="twin" [excitation]="planning" [adaptation]="dynamics"
)
declare -A all  # module -> everything it may include
reach() {  # module
  local below
  [ -n "${all[$1]+known}" ] && return
  all[$1]=" $1 "
  for below in ${may[$1]}; do
    reach "$below"
    all[$1]+="${all[$below]}"
  done
}
failed=0
for file in include/chainsplat/*.h include/chainsplat/*/*.h src/*/*.h src/*/*.cpp; do
  [ -e "$file" ] || continue
  case $file in
    include/*) module=${file#include/chainsplat/} module=${module%%[./]*} ;;
    *) module=$(basename "$(dirname "$file")") ;;
  esac
  if [ -z "${may[$module]+known}" ]; then
    echo "$file: module '$module' is not in the table"
    failed=1
    continue
  fi
  reach "$module"
  while read -r used; do
    [[ ${all[$module]} == *" $used "* ]] && continue
    echo "$file: $module must not include chainsplat/$used.h"
    failed=1
  done < <(sed -n 's|^ *# *include *"chainsplat/\([a-z_]*\)[./].*".*|\1|p' "$file")
done
exit $failed
