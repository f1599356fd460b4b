#!/bin/bash
# Recordings for Foxglove and rerun, read back by another program than ours: tests/read_mcap.py, and by the package `mcap`
# where Python has it. Needs python3 alone.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30
python=${CHAINSPLAT_PYTHON:-python3}
run train "$demo" -o "$work/run" --frames 0:40
expect_code 0 train
run export "$work/run" -o "$work/run.mcap"
expect_code 0 'export .mcap'
run export "$work/run" -o "$work/RUN.MCAP"
cmp -s "$work/run.mcap" "$work/RUN.MCAP" || fail 'the same recording twice has other bytes, or its ending in capitals other content'
run export "$work/run" -o "$work/run.csv"
run estimate "$work/run" --camera "$demo:cam0" --mcap "$work/live.mcap"
expect_code 0 'estimate --mcap'
mv "$work/stdout" "$work/live.jsonl"

"$python" - "$source_dir/tests" "$work" "$demo" <<'PYTHON' || fail 'the recordings are not what the other files say'
import csv, json, math, struct, sys
sys.path.insert(0, sys.argv[1])
from read_mcap import read
work, demo = sys.argv[2], json.load(open(sys.argv[3] + '/capture.json'))
topics, schemas = read(work + '/run.mcap')
assert schemas['/tf'] == 'foxglove.FrameTransforms' and schemas['/rope/wrench'] == 'chainsplat.Wrench', schemas

def stamp(message):
    return message['timestamp'].get('seconds', 0) + 1e-9 * message['timestamp'].get('nanos', 0)

def vector(message):
    return [message[name] for name in 'xyz']

def turned(q, v):  # by the quaternion
    x, y, z, w = (q[name] for name in 'xyzw')
    t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])]
    return [v[i] + w * t[i] + c for i, c in enumerate([y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0]])]

def near(a, b, by):
    return all(abs(x - y) <= by for x, y in zip(a, b, strict=True))

# angles, rates and points are those of the tables
states = list(csv.DictReader(open(work + '/run.csv')))
nodes = [[float(x) for x in row[1:]] for row in list(csv.reader(open(work + '/run.centerline.csv')))[1:]]
joints, lines, links, frames = (topics[name] for name in ('/rope/joints', '/rope/centerline', '/rope/links', '/tf'))
assert len(states) == 40 and {len(topics[t]) for t in topics if t.startswith(('/rope', '/tf'))} == {40}
for row, line, (time, joint), (_, scene), (_, poses), (_, tf) in zip(states, nodes, joints, lines, links, frames):
    assert abs(float(row['time']) - 1e-9 * time) < 1e-9 and abs(stamp(joint) - 1e-9 * time) < 1e-9
    for each in joint['joints']:
        assert each['position'] == float(row[each['name']])
        assert each['velocity'] == float(row[each['name'].replace('theta', 'thetadot')])
    (entity,) = scene['entities']
    assert near(sum((vector(p) for p in entity['lines'][0]['points']), []), line, 1e-9)
    assert entity['lines'][0]['thickness'] == demo['object']['diameter']
    # the chain of transforms leads to the links' poses, and these to the nodes: a link begins at its joint
    turn, place = [], [0, 0, 0]
    chain = [t for t in tf['transforms'] if t['child_frame_id'].startswith('link_')]
    assert [t['parent_frame_id'] for t in chain] == ['world'] + [t['child_frame_id'] for t in chain[:-1]]
    for k, (t, pose) in enumerate(zip(chain, poses['poses'], strict=True)):
        step = vector(t['translation'])
        for q in reversed(turn):
            step = turned(q, step)
        place = [a + b for a, b in zip(place, step)]
        turn.append(t['rotation'])
        assert near(place, vector(pose['position']), 1e-9), k
        assert near(place, line[3 * k:3 * k + 3], 1e-9), k

# cameras: the first transforms place them; pixel (0, 0) is centered at 0 there and at one half here
placed = {t['child_frame_id']: t for t in frames[0][1]['transforms']}
for camera in demo['cameras']:
    name, matrix = camera['name'], camera['world_from_camera']
    (_, facts), = topics[f'/cameras/{name}/calibration']
    pictures = topics[f'/cameras/{name}/image']
    assert (facts['width'], facts['height'], facts['frame_id']) == (camera['width'], camera['height'], name)
    assert near(facts['K'], [camera['fx'], 0, camera['cx'] - .5, 0, camera['fy'], camera['cy'] - .5, 0, 0, 1], 0.5)
    assert len(facts['D']) == 5 and len(facts['P']) == 12 and facts['distortion_model'] == 'plumb_bob'
    assert near(vector(placed[name]['translation']), matrix[3:12:4], 5e-3)
    for axis in range(3):
        mine = turned(placed[name]['rotation'], [float(i == axis) for i in range(3)])
        assert near(mine, matrix[axis:12:4], 1e-2)
    assert len(pictures) == 60 and pictures[0][1]['format'] == 'jpeg' and pictures[0][1]['frame_id'] == name
    for _, picture in pictures:
        at = picture['data'].index(b'\xff\xc0') + 5  # start of frame: height, width
        assert struct.unpack('>HH', picture['data'][at:at + 4]) == (camera['height'], camera['width'])

# points: on the rope, in its colors
for (_, cloud), line in zip(topics['/rope/points'], nodes):
    assert cloud['point_stride'] == 16 and [f['name'] for f in cloud['fields']][:3] == ['x', 'y', 'z']
    for at in range(0, len(cloud['data']), 16 * 37):
        point = struct.unpack('<3f', cloud['data'][at:at + 12])
        away = min(math.dist(point, line[k:k + 3]) for k in range(0, len(line), 3))
        assert away < 0.5 * demo['object']['length'] / 8 + demo['object']['diameter'], away

# at rest in the beginning, the gripper holds what the rope weighs
(_, wrench) = topics['/rope/wrench'][0]
assert wrench['unit'] == 'N' and abs(wrench['force']['z'] / (9.81 * demo['object']['mass']) - 1) < 0.2, wrench

live, _ = read(work + '/live.mcap')
told = [json.loads(line) for line in open(work + '/live.jsonl')]
assert len(told) == len(live['/rope/status']) == len(live['/cameras/cam0/image']) == 60 and '/rope/points' not in live
for line, (time, joint), (_, status) in zip(told, live['/rope/joints'], live['/rope/status'], strict=True):
    assert near([j['position'] for j in joint['joints']], line['theta'], 1e-6) and abs(1e-9 * time - line['time']) < 1e-6
    assert status['status'] == line['status'] and abs(1e3 * status['latency'] - line['latency_ms']) < 0.01
settled = sum(line['status'] == 'following' and not line['settling'] for line in told)
assert len(live['/rope/force']) == settled - 2 > 50 and live['/rope/force'][0][1]['unit'] == 'N'
PYTHON
"$python" - "$work" <<'PYTHON' || fail 'the package mcap does not read it'
import sys
try:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory
except ImportError:
    print('not read with the package mcap: python3 has no mcap_protobuf')
    sys.exit()
for name in 'run', 'live':
    with open(f'{sys.argv[1]}/{name}.mcap', 'rb') as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        count = reader.get_summary().statistics.message_count
        assert sum(1 for _ in reader.iter_decoded_messages()) == count > 0
PYTHON

expect_error 2 'is there already; name another file, or give --force' export "$work/run" -o "$work/run.mcap"
expect_error 2 'standard output is for the estimates' estimate "$work/run" --camera "$demo:cam0" --mcap -
expect_error 2 'nowhere' estimate "$work/run" --camera "$demo:cam0" --mcap "$work/nowhere/live.mcap"
python3 -c 'import json, sys; print(json.dumps(json.load(open(sys.argv[1]))["cameras"][0]))' "$demo/capture.json" >"$work/camera.json"
expect_error 2 'has no frame' estimate "$work/run" --camera - --calibration "$work/camera.json" --mcap "$work/empty.mcap"
[ ! -e "$work/empty.mcap" ] || fail 'estimate without a frame: left a recording'
run export "$work/run" -o "$work/run.mcap" --force --no-pictures
expect_code 0 'without pictures'
"$python" "$source_dir/tests/read_mcap.py" "$work/run.mcap" | grep -q cameras && fail 'pictures although --no-pictures'
# times before 0 are legal here and not there
"$python" - "$work" "$demo" <<'PYTHON'
import sys
for source, out, apart in (('run/states.csv', 'states.csv', ','), (sys.argv[2] + '/base.tum', 'base.tum', ' ')):
    rows = open(source if source[0] == '/' else f'{sys.argv[1]}/{source}').read().splitlines()
    head = [row for row in rows if row[0] in 't#']
    early = [apart.join([repr(float(row.split(apart)[0]) - 10), *row.split(apart)[1:]]) for row in rows if row not in head]
    open(f'{sys.argv[1]}/{out}', 'w').write('\n'.join(head + early) + '\n')
PYTHON
expect_error 2 'is before 0, which MCAP does not have' export "$work/run" -o "$work/early.mcap" --no-pictures \
  --states "$work/states.csv" --base "$work/base.tum"
[ -z "$(ls "$work" | grep early)" ] || fail 'something is left of what was refused'
finish
