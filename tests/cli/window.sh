#!/bin/bash
# The live window before clients that mean no good, and in a real browser: chromium without a screen opens the page, and
# what it drew is read back. The latter is skipped (77) where there is no chromium.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
demo=$source_dir/assets/demo_free_30
browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome) || browser=
port=$((20000 + $$ % 20000))
# a twin without dynamics that has been recognized once, hanging straight
run new --length 0.3 --joints 4 --bending planar -o "$work/twin"
expect_code 0 new
sed -i '$d' "$work/twin/twin.json"
echo ', "states": "states.csv"}' >>"$work/twin/twin.json"
printf 'time,theta_1,theta_2,theta_3,theta_4\n0,0,0,0,0\n' >"$work/twin/states.csv"
cp "$demo/base.tum" "$work/twin/"

# a port that is taken, and one that is none
python3 -c "
import socket, sys, time
s = socket.socket(); s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
s.bind(('127.0.0.1', $port)); s.listen(); print('taken', flush=True); time.sleep(60)" >"$work/taken" 2>/dev/null &
holder=$!
for _ in $(seq 50); do [ -s "$work/taken" ] && break; sleep 0.1; done
if [ -s "$work/taken" ]; then
  expect_error 2 "--serve $port.*cannot be had" estimate "$work/twin" --camera "$demo:cam0" --serve "$port"
fi
kill "$holder" 2>/dev/null
expect_error 2 'serve' estimate "$work/twin" --camera "$demo:cam0" --serve 0

# inputs are looked at first: a window that opens and ends at once
for _ in $(seq 10); do
  timeout -k 1 20 "$program" estimate "$work/twin" --camera "$demo:cam0" --serve "$port" --base "$work/missing.tum" \
    >"$work/stdout" 2>"$work/stderr" </dev/null
  code=$?
  expect_code 2 'a base motion that is missing'
  grep -q 'Live window' "$work/stderr" && fail 'a base motion that is missing: the window was opened'
  [ "$code" -eq 2 ] || break
done

# Asks of the window that is open at a port: a name of a check and a request; what the first line of the answer must
# begin with. Then sixty clients that send nothing, send slowly or never read: the page must still be there.
cat >"$work/clients.py" <<'END'
import os, signal, socket, sys, time
port, pid = int(sys.argv[1]), int(sys.argv[2])

def connect():
    s = socket.create_connection(("127.0.0.1", port), timeout=5)
    return s

def answer(request, half_closed=False):
    with connect() as s:
        try:
            s.sendall(request)
            if half_closed:
                s.shutdown(socket.SHUT_WR)
        except OSError:
            pass
        got = b""
        try:
            while block := s.recv(65536):
                got += block
        except OSError as error:
            return got or repr(error).encode()
        return got

def get(path, host=f"127.0.0.1:{port}", method="GET", more=""):
    return f"{method} {path} HTTP/1.1\r\nHost: {host}\r\n{more}Connection: close\r\n\r\n".encode()

def expect(name, status, got):
    if not got.startswith(b"HTTP/1.1 %d " % status):
        print(f"{name}: {got[:60]!r} instead of {status}")

def expect_page(name):
    begun = time.monotonic()
    expect(name, 200, answer(get("/")))
    if time.monotonic() - begun > 2.0:
        print(f"{name}: took {time.monotonic() - begun:.1f} s")

for _ in range(200):
    try:
        connect().close()
        break
    except OSError:
        time.sleep(0.05)
expect_page("the page")
expect("half-closed", 200, answer(get("/"), True))
expect("localhost", 200, answer(get("/", f"localhost:{port}")))
expect("no port", 200, answer(get("/", "127.0.0.1")))
for host in (f"127.0.0.1:{port}@evil", "127.0.0.1:80@evil", f"127.0.0.1:{port + 1}", f"evil:{port}", "127.0.0.1:", "",
             f"127.0.0.1:{port}:{port}", f"127.0.0.1.evil:{port}", f"evil@127.0.0.1:{port}", f"[::1]:{port}"):
    expect(f"Host: {host}", 403, answer(get("/", host)))
expect("no Host", 400, answer(b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n"))
expect("two Hosts", 400, answer(get("/", more="Host: evil\r\n")))
for path in ("/../../etc/passwd", "/%2e%2e/etc/passwd", "//", "/next/", "/nextafter"):
    expect(path, 404, answer(get(path)))
expect("no path", 404, answer(get("etc/passwd")))
for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE", "get"):
    expect(method, 405, answer(get("/", method=method)))
expect("POST with a body", 405, answer(get("/", method="POST", more="Content-Length: 99999999\r\n") + b"x" * 100000))
head = answer(get("/", method="HEAD"))
expect("HEAD", 200, head)
if not head.endswith(b"\r\n\r\n") or b"Content-Length: 0" in head:
    print("HEAD: not the head of GET")
expect("huge head", 431, answer(b"GET / HTTP/1.1\r\nX: " + b"x" * 1000000))
expect("garbage", 400, answer(bytes(range(256)) + b"\r\n\r\n"))
if answer(b"\x16\x03\x01\x02\x00\x01\r\n\r\n").startswith(b"HTTP/1.1 2"):
    print("TLS: answered")
expect("HTTP/9", 505, answer(b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n"))
expect("folded", 400, answer(get("/", more=" evil\r\n")))
for after in ("", "?after=", "?after=-1", "?after=99999999999999999999", "?x", "?after=nan"):
    expect("/next" + after, 204, answer(get("/next" + after)))
two = get("/nothing").replace(b"close", b"keep-alive") + get("/")
expect("two at once", 404, answer(two))
if answer(two).count(b"HTTP/1.1 ") != 2:
    print("two at once: not two answers")

clients = [connect() for _ in range(60)]
for i, s in enumerate(clients):
    s.setblocking(False)
    try:
        s.send((b"", b"G", get("/").replace(b"close", b"keep-alive") * 500)[i % 3])
    except OSError:
        pass
slow = clients[1::3]
for turn in range(4):
    expect_page("the page beside sixty slow clients")
    for s in slow:
        try:
            s.send(b"E")
        except OSError:
            pass
    time.sleep(0.1)
more = []
for _ in range(40):  # the places are taken to the end
    try:
        more.append(connect())
        more[-1].send(get("/").replace(b"close", b"keep-alive") * 2000)
    except OSError:
        pass
begun = time.monotonic()
os.kill(pid, signal.SIGTERM)
while time.monotonic() - begun < 5.0:
    try:
        os.kill(pid, 0)
        if open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()[0] == "Z":
            break
    except OSError:
        break
    time.sleep(0.02)
if time.monotonic() - begun > 1.5:
    print(f"ended {time.monotonic() - begun:.1f} s after SIGTERM")
END
{ echo '{"name": "cam0", "width": 320, "height": 240, "fx": 307.5, "fy": 307.5, "cx": 160, "cy": 120, "rate": 30,'
  echo ' "world_from_camera": [1,0,0,0, 0,0,1,-0.8, 0,-1,0,0.4, 0,0,0,1]}'; } >"$work/camera.json"
mkfifo "$work/pipe"
"$program" estimate "$work/twin" --camera - --calibration "$work/camera.json" --serve "$port" \
  <"$work/pipe" >"$work/stdout" 2>"$work/stderr" &
estimator=$!
exec 3>"$work/pipe"
timeout 60 python3 "$work/clients.py" "$port" $estimator >"$work/said" 2>&1
code=$?
: >"$work/stderr"
[ -s "$work/said" ] && fail "clients: $(head -20 "$work/said")"
[ "$code" -eq 0 ] || fail "clients: exit code $code"
exec 3>&-
kill -KILL $estimator 2>/dev/null
{ wait $estimator; } 2>/dev/null
code=$?
expect_code 143 'SIGTERM beside slow clients'

if [ -z "$browser" ]; then
  echo 'skipped: there is no chromium'
  [ "$failures" -eq 0 ] && exit 77
  finish
fi

# Two seconds of capture may be over before the browser is there: estimate runs again and again while it looks.
port=$((port + 1))
(while [ ! -e "$work/enough" ]; do
  "$program" estimate "$work/twin" --camera "$demo:cam0" --serve "$port" >"$work/lines" 2>"$work/stderr" </dev/null
  echo "$? $(grep -c '"frame":' "$work/lines")" >>"$work/runs"
done) &
estimator=$!
browse "$port" 'data-frames="[0-9]'
touch "$work/enough"
wait "$estimator"
# the estimator comes to its end whether or not somebody looks
grep -qv '^0 60$' "$work/runs" && fail "estimate --serve: exit code and lines are $(tr '\n' ';' <"$work/runs")"
grep -q 'data-frames="[0-9]' "$work/dom" || fail 'the page shows no frame'
grep -q 'data-line="[1-9]' "$work/dom" || fail 'the page drew no chain'
grep -q 'data-bars="[1-9]' "$work/dom" || fail 'the latency plot is empty'
grep -Eq 'id="trust" class="(good|doubt|bad)"' "$work/dom" || fail 'the page says nothing about trust'
finish
