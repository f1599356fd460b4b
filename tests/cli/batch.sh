#!/bin/bash
# Batches: wrong job files, a run that is interrupted and run again, a job that fails beside one that does not, results.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30
mkdir "$work/captures"
ln -s "$demo" "$work/captures/good"
mkdir "$work/captures/broken"

refused() {  # pattern; the job file comes from standard input
  cat >"$work/jobs.toml"
  expect_error 2 "$1" batch "$work/jobs.toml" -o "$work/none"
  [ -e "$work/none" ] && fail "$1: something was written" && rm -rf "$work/none"
}
refused "unknown key 'capture'; the nearest one is 'captures'" <<<'capture = ["captures/*"]'
refused "unknown key 'joint_count'; the nearest one is 'joint" <<'E1'
captures = ["captures/*"]
[settings]
joint_count = 8
E1
refused 'settings\.mode: .*paper' <<'E1'
captures = ["captures/*"]
[settings]
mode = ["fast", "papr"]
E1
refused "'captures/none_\*' matches no folder" <<<'captures = ["captures/none_*"]'
refused "the same output 'good' twice" <<<'captures = ["captures/good", "captures/g*"]'
refused 'jobs.toml: line 1: ' <<<'captures = ["captures/good"'
refused 'seeds' <<<'captures = "captures/good"
seeds = [-1]'
refused 'settings.output: is chosen by the batch' <<<'captures = "captures/good"
settings = { output = "x" }'
# lists in lists, tables in tables and JSON without end are refused in a line, long before the stack is full
refused 'jobs.toml: line 1: .*depth' < <(printf 'captures = '; head -c 200000 /dev/zero | tr '\0' '[')
refused 'jobs.toml: line 1: has more than 100 dots' < <(printf 'a'; yes .a | head -n 400000 | tr -d '\n'; echo ' = 1')
refused 'jobs.toml: line 1: has more than 100 dots' < <(printf '[a'; yes .a | head -n 400000 | tr -d '\n'; echo ']')
mkdir -p "$work/deep/logs"
head -c 200000 /dev/zero | tr '\0' '[' >"$work/deep/batch.json"
expect_error 2 'batch\.json: is damaged' batch status "$work/deep"
job='"capture": "x", "settings": "", "seed": 0, "arguments": []'
echo "{\"jobs\": [{\"name\": \"../../x\", $job}]}" >"$work/deep/batch.json"
expect_error 2 "batch\\.json: .*'\.\./\.\./x'" batch status "$work/deep"
echo "{\"jobs\": [{\"name\": \"one\", $job}]}" >"$work/deep/batch.json"
head -c 200000 /dev/zero | tr '\0' '[' >"$work/deep/logs/one.json"
mkdir -p "$work/deep/one/checkpoint"
for record in "$(head -c 3000 /dev/zero | tr '\0' '[')" '{"stage": 5}' '{"stage": "x", "iteration": [1], "total": 2}'; do
  echo "$record" >"$work/deep/one/log.jsonl"
  run batch status "$work/deep"
  expect_code 0 'batch status, a damaged state'
  expect_output '^stopped .* one$' 'batch status, a damaged state'
done
printf '{"stage": "red \\u001b[31m"}\n' >"$work/deep/one/log.jsonl"
run batch status "$work/deep"
expect_output 'red .x1b\[31m' 'batch status, control characters'
printf '{"arguments": [], "code": 0, "stopped": false, "seconds": 1, "error": ""}' >"$work/deep/logs/one.json"
rm -r "$work/deep/one/checkpoint"
for twin in "$(head -c 200000 /dev/zero | tr '\0' '[')" '{"chain": 5, "provenance": {}}' '[]'; do
  echo "$twin" >"$work/deep/one/twin.json"
  run batch collect "$work/deep"
  expect_code 0 'batch collect, a damaged twin'
  grep -q 'warning: .*twin.json: is damaged' "$work/stderr" || fail 'batch collect, a damaged twin: no warning'
done
expect_error 2 'not the folder of a batch' batch status "$work"
mkdir "$work/other" && touch "$work/other/file"
cat >"$work/jobs.toml" <<'E1'
captures = ["captures/*"]
[settings]
joints = [3]
bending = "planar"
frames = "0:6"
E1
expect_error 2 'not of a batch' batch "$work/jobs.toml" -o "$work/other"
(PATH=/nonexistent exec "$program" batch "$work/jobs.toml" -o "$work/none" --launcher slurm) >"$work/stdout" 2>"$work/stderr"
code=$?
expect_code 2 'slurm where there is none'
grep -q "^chainsplat: error: --launcher slurm: there is no 'sbatch'.*; " "$work/stderr" || fail 'slurm where there is none: no error line'

# a folder whose name Slurm would fill in
mkdir "$work/bin"
printf '#!/bin/bash\nprintf "%%s\\n" "$@" >"%s/sbatch"; echo 7\n' "$work" >"$work/bin/sbatch"
chmod +x "$work/bin/sbatch"
PATH="$work/bin:$PATH" run batch "$work/jobs.toml" -o "$work/100%j" --launcher slurm
expect_code 0 'slurm, a folder with a percent sign'
grep -q '^--output=.*/100%%j/logs/slurm-%a\.txt$' "$work/sbatch" || fail 'slurm: the folder of the logs is filled in'
PATH="$work/bin:$PATH" run --json batch "$work/jobs.toml" -o "$work/100%j" --launcher slurm
expect_output '"slurm_job": "7"' 'slurm --json'

# interrupted at work: the trainings leave checkpoints
"$program" batch "$work/jobs.toml" -o "$work/batch" >"$work/stdout" 2>"$work/stderr" </dev/null &
pid=$!
wait_for_file "$work/batch/good-joints_3/checkpoint/recognize.bin" $pid
expect_error 2 'another process' batch "$work/jobs.toml" -o "$work/batch"
kill -INT $pid
wait $pid
code=$?
expect_code 130 'an interrupted batch'
run batch status "$work/batch"
expect_code 0 'batch status'
expect_output '^stopped .*good-joints_3  recognize' 'batch status'
expect_output '^failed .*broken-joints_3  .*capture\.json' 'batch status'

# again: one goes on from its checkpoint, the other fails, as it must
expect_failure() {
  run batch "$work/jobs.toml" -o "$work/batch"
  expect_code 1 'a batch with a broken capture'
  grep -q '^chainsplat: error: .*1 of 2 jobs failed' "$work/stderr" || fail 'a batch with a broken capture: no error line'
}
expect_failure
grep -q '^done .*good-joints_3' "$work/stderr" || fail 'batch: the sound job is not done'
stamp=$(stat -c %Y.%i "$work/batch/good-joints_3/twin.json")
expect_failure
grep -q '1 of them done already' "$work/stderr" || fail 'batch again: does not know what is done'
[ "$stamp" = "$(stat -c %Y.%i "$work/batch/good-joints_3/twin.json")" ] || fail 'batch again: did a done job anew'
# a task whose job is done still answers in JSON
index=$(python3 -c 'import json, sys; print([j["name"] for j in json.load(open(sys.argv[1]))["jobs"]].index("good-joints_3"))' "$work/batch/batch.json")
run batch task "$work/batch" --index "$index" --json
expect_code 0 'batch task --json'
python3 - "$work/stdout" <<'PYTHON' || fail 'batch task --json: not the JSON of its job'
import json, sys
(job,) = json.load(open(sys.argv[1]))['jobs']
assert job['name'] == 'good-joints_3' and job['state'] == 'done', job
PYTHON
sed -i 's/planar/spatial/' "$work/jobs.toml"
expect_error 2 'made with other options' batch "$work/jobs.toml" -o "$work/batch"

run batch status "$work/batch" --json
expect_output '"state": "done"' 'batch status --json'
run batch collect "$work/batch"
expect_code 0 'batch collect'
[ "$(wc -l <"$work/batch/results.csv")" -eq 3 ] || fail 'batch collect: results.csv has not a row a job'
grep -q '^good-joints_3,.*,free,0.3,joints=3,0,done,,' "$work/batch/results.csv" || fail 'batch collect: no row of the done job'
grep -q '<td>0.0265</td>\|0.0265' "$work/batch/results.html" || fail "batch collect: the paper's figure is missing"
grep -q 'href="good-joints_3/"' "$work/batch/results.html" || fail 'batch collect: no link to the run'
grep -q 'href="good-joints_3/report.html"' "$work/batch/results.html" || fail 'batch collect: no link to the report'
grep -Eq 'https?://' "$work/batch/results.html" && fail 'batch collect: results.html is not self-contained'

# diff: a run and itself, and another
run diff "$work/batch/good-joints_3" "$work/batch/good-joints_3"
expect_code 0 diff
expect_output '^result: the same$' diff
cp -r "$work/batch/good-joints_3" "$work/changed"
sed -i 's/"seed": 0/"seed": 5/; s/"version": "[^"]*"/"version": "0.0.1"/' "$work/changed/twin.json"
run diff "$work/batch/good-joints_3" "$work/changed"
expect_output '^  seed +0 +5' diff
expect_output '^  version +[0-9.]+ +0\.0\.1' diff
run diff "$work/batch/good-joints_3" "$work/changed" --json
[ "$(head -c 1 "$work/stdout")" = '{' ] || fail 'diff --json: does not begin with {'
expect_error 2 'twin.json' diff "$work/batch/good-joints_3" "$work/none"
finish
