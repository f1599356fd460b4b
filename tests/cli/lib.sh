# What the scripts share. Each is called with the program, in a folder that may be written.
program=$1
[ -x "$program" ] || { echo "FAILED: there is no program '$program'"; exit 1; }
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
work=$(mktemp -d "$PWD/cli.XXXXXX")
trap 'rm -rf "$work"' EXIT
failures=0

fail() {  # text
  echo "FAILED: $1"
  [ -s "$work/stderr" ] && sed 's/^/  stderr: /' "$work/stderr"
  failures=$((failures + 1))
}

run() {  # arguments of the program; leaves $code, $work/stdout, $work/stderr
  "$program" --no-progress "$@" >"$work/stdout" 2>"$work/stderr" </dev/null
  code=$?
}

expect_code() {  # code name
  [ "$code" -eq "$1" ] || fail "$2: exit code $code instead of $1"
}

# The program must end with `code` and exactly one error line of the right form that matches `pattern`.
expect_error() {  # code pattern arguments...
  local wanted=$1 pattern=$2
  shift 2
  run "$@"
  expect_code "$wanted" "$*"
  [ "$(grep -c '^chainsplat: error: ' "$work/stderr")" -eq 1 ] || fail "$*: not exactly one error line"
  grep -Eq '^chainsplat: error: .+: .+; .+$' "$work/stderr" || fail "$*: the line is not WHERE: WHAT; HOW TO MEND"
  grep '^chainsplat: error: ' "$work/stderr" | grep -Eq -- "$pattern" || fail "$*: the line does not match '$pattern'"
  grep -Evq '^chainsplat: (error|warning): ' "$work/stderr" && fail "$*: more than errors and warnings on standard error"
  [ -s "$work/stdout" ] && fail "$*: an error, but standard output is not empty"
}

expect_output() {  # pattern name
  grep -Eq -- "$1" "$work/stdout" || fail "$2: standard output does not match '$1'"
}

# Looks at a page of the loopback address with the browser $browser until its document matches; it is left in $work/dom.
browse() {  # port pattern
  local look
  for look in $(seq 20); do  # a busy machine needs several
    timeout 60 "$browser" --headless --no-sandbox --disable-gpu --user-data-dir="$work/profile" \
      --virtual-time-budget=1500 --window-size=1000,560 --dump-dom "http://127.0.0.1:$1/" >"$work/dom" 2>/dev/null
    grep -q "$2" "$work/dom" && return
    sleep 0.5
  done
}

# Waits until the process has written a file with something in it, or has ended.
wait_for_file() {  # file pid
  local look
  for look in $(seq 6000); do
    [ -s "$1" ] && return
    kill -0 "$2" 2>/dev/null || return
    sleep 0.01
  done
}

# A twin without dynamics that has been recognized once, hanging straight.
make_straight_twin() {  # twin capture
  run new --length 0.3 --joints 8 --bending spatial -o "$1"
  expect_code 0 new
  sed -i '$d' "$1/twin.json"
  echo ', "states": "states.csv"}' >>"$1/twin.json"
  { echo "time$(seq -f ',theta_%g' -s '' 16)"; echo "0$(printf ',0%.0s' {1..16})"; } >"$1/states.csv"
  cp "$2/base.tum" "$1/"
}

finish() {
  [ "$failures" -eq 0 ] && echo "all passed" || echo "$failures failed"
  exit $((failures > 0))
}
