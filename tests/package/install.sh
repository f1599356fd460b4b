#!/bin/bash
# Installs the build into a folder, and uses it from there alone: a program by find_package and one by pkg-config, every
# installed header by itself, the Python module.
#
#   install.sh BUILD ASSETS
set -euo pipefail
build=$1 demo=$2/demo_free_30 here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
fail() {
  echo "FAILED: $1"
  exit 1
}
prefix=$work/prefix
cmake --install "$build" --prefix "$prefix" >"$work/install.txt" || fail "cmake --install: $(tail -3 "$work/install.txt")"
library=$(dirname "$(find "$prefix" -name 'libchainsplat.so')")

# the manual page names every command, and the shell can read what completes them
page=$(zcat "$prefix/share/man/man1/chainsplat.1.gz") || fail 'no manual page'
for command in $("$prefix/bin/chainsplat" --help | sed -nE '/^Subcommands:/,$ s/^  ([a-z]+) .*/\1/p'); do
  grep -q "fB$command" <<<"$page" || fail "the manual page has no $command"
done
bash -n "$prefix/share/bash-completion/completions/chainsplat" || fail 'completions of bash'

# nothing but Eigen and the standard library is named by the headers
foreign=$(grep -rhoE '#include <[a-zA-Z_]+/[^>]*>' "$prefix/include" | grep -v '<Eigen/' | sort -u || true)
[ -z "$foreign" ] || fail "installed headers include $foreign"
! grep -rlE 'nlohmann|VkDevice|cv::|OIIO|AVFrame|YAML|glm::' "$prefix/include" | grep . || fail 'installed headers name other libraries'
flags=$(PKG_CONFIG_PATH=$library/pkgconfig pkg-config --cflags chainsplat)
for header in $(cd "$prefix/include" && find . -name '*.h' | sort); do
  echo "#include <${header#./}>"
done >"$work/all.cpp"
while read -r line; do  # each alone
  echo "$line" >>"$work/one.txt"
done <"$work/all.cpp"
split -l 8 "$work/one.txt" "$work/part_"
for part in "$work"/part_*; do  # in the opposite order, so that none leans on those before it
  tac "$part" >"$part.cpp"
  # shellcheck disable=SC2086
  c++ -std=c++20 -fsyntax-only -Wall -Wextra $flags "$part.cpp" || fail "installed headers do not compile"
done

# so does what docs/api.md shows: its blocks, one after the other, as one program
awk '/^```cpp/ { n++; inside = 1; if (n == 2) print "#include <cstdio>\nint main() {"; next } /^```/ { inside = 0 } inside
  END { print "}" }' "$here/../../docs/api.md" >"$work/shown.cpp"
# shellcheck disable=SC2086
c++ -std=c++20 -fsyntax-only $flags "$work/shown.cpp" || fail 'docs/api.md does not compile'

# only the library's own names are exported
others=$(nm -DC --defined-only "$library/libchainsplat.so" | cut -c20- | grep -vE 'chainsplat::|^[AVWTBDR] *$' | head -3 || true)
[ -z "$others" ] || fail "the library exports $others"

# a program by find_package: trains, rolls out, draws
cmake -S "$here/cpp" -B "$work/own" -G Ninja -DCMAKE_PREFIX_PATH="$prefix" >"$work/configure.txt" 2>&1 ||
  fail "find_package: $(cat "$work/configure.txt")"
cmake --build "$work/own" >"$work/make.txt" 2>&1 || fail "$(cat "$work/make.txt")"
rows=$("$work/own/own" "$demo" "$work/run" "$work/picture.png") || fail "the program by find_package"
[ "$rows" = '61 rows' ] || fail "the program by find_package says '$rows'"
[ -s "$work/picture.png" ] && [ -s "$work/run/twin.json" ] || fail 'no picture or no twin'

# by pkg-config
# shellcheck disable=SC2046
c++ -std=c++20 -o "$work/own_pc" "$here/cpp/main.cpp" $(PKG_CONFIG_PATH=$library/pkgconfig pkg-config --cflags --libs chainsplat) ||
  fail 'pkg-config'
LD_LIBRARY_PATH=$library "$work/own_pc" /nowhere "$work/none" "$work/none.png" 2>"$work/error.txt" && fail 'trains nothing'
grep -q '^/nowhere.*: .*; ' "$work/error.txt" || fail "an error arrives as $(cat "$work/error.txt")"

# a newer minor version is another ABI, and is refused
sed 's/find_package(chainsplat/& 99.0/' "$here/cpp/CMakeLists.txt" >"$work/CMakeLists.txt"
cmake -S "$work" -B "$work/newer" -G Ninja -DCMAKE_PREFIX_PATH="$prefix" >"$work/newer.txt" 2>&1 && fail 'version 99 is found'
grep -q 'version: 0' "$work/newer.txt" || fail "a missing version is told as $(cat "$work/newer.txt")"

"$prefix/bin/chainsplat" --version >"$work/version.txt" || fail 'the installed program'

# the Python module, where it was built
module=$(find "$prefix" -type d -path '*/dist-packages')
if [ -n "$module" ]; then
  cd "$work"
  PYTHONPATH=$module /usr/bin/python3 "$here/own.py" "$demo" "$work/python_run" >"$work/python.txt" || fail 'the Python script'
  grep -q '^(61, 240, 320, 3) rope$' "$work/python.txt" || fail "the Python script says $(cat "$work/python.txt")"
else
  echo 'no Python module was built'
fi
echo ok
