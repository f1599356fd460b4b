#!/bin/bash
# Modules include only what is below them: reads all #include "chainsplat/..." lines and compares them with the table of
# modules in docs/architecture.md. A module may include the headers of those in its row, and of what those may use.
cd "$(dirname "$0")/.." || exit 1
declare -A may=() module_of=() all=()  # module -> what it may use; header -> module; module -> all that it may include
while IFS='|' read -r _ level module _ uses headers _; do
  [[ $level =~ ^\ *[0-9]+\ *$ ]] || continue
  module=${module// /}
  may[$module]=$uses
  for header in $headers; do module_of[$header]=$module; done
done <docs/architecture.md
failed=0
complain() {  # line
  echo "$1"
  failed=1
}

reach() {  # module
  local below
  [ -n "${all[$1]+known}" ] && return
  all[$1]=" $1 "
  for below in ${may[$1]}; do
    [ -n "${may[$below]+known}" ] || complain "docs/architecture.md: $1 may use '$below', which is no module"
    reach "$below"
    all[$1]+="${all[$below]}"
  done
}

[ ${#may[@]} -gt 0 ] || complain 'docs/architecture.md: no table of modules'
for module in "${!may[@]}"; do
  reach "$module"
  [ -d "src/$module" ] || complain "docs/architecture.md: there is no src/$module"
done
for header in "${!module_of[@]}"; do
  [ -e "include/chainsplat/$header" ] || complain "docs/architecture.md: there is no include/chainsplat/$header"
done
for file in include/chainsplat/*.h include/chainsplat/*/*.h src/*/*.h src/*/*.cpp; do
  [ -e "$file" ] || continue
  case $file in
    include/*) module=${module_of[${file#include/chainsplat/}]:-} ;;
    *) module=$(basename "$(dirname "$file")") ;;
  esac
  if [ -z "$module" ] || [ -z "${may[$module]+known}" ]; then
    complain "$file: is not in the table of docs/architecture.md"
    continue
  fi
  while read -r used; do
    [[ ${all[$module]} == *" ${module_of[$used]:-?} "* ]] || complain "$file: $module must not include chainsplat/$used"
  done < <(sed -n 's|^ *# *include *"chainsplat/\([a-z_/]*\.h\)".*|\1|p' "$file")
done
exit $failed
