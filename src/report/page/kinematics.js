// The motion of the chain, as the program computes it (docs/mathematics.md 2.2). A pose is 12 numbers: the rotation row
// by row, then the translation.

const turn = (p, x) => [p[0] * x[0] + p[1] * x[1] + p[2] * x[2], p[3] * x[0] + p[4] * x[1] + p[5] * x[2],
                        p[6] * x[0] + p[7] * x[1] + p[8] * x[2]];
const turnBack = (p, x) => [p[0] * x[0] + p[3] * x[1] + p[6] * x[2], p[1] * x[0] + p[4] * x[1] + p[7] * x[2],
                            p[2] * x[0] + p[5] * x[1] + p[8] * x[2]];
const add = (a, b) => a.map((v, i) => v + b[i]);
const minus = (a, b) => a.map((v, i) => v - b[i]);
const scaled = (a, s) => a.map(v => v * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => scaled(a, 1 / Math.hypot(...a));
const move = (p, x) => add(turn(p, x), p.slice(9));

function compose(a, b) {
  const out = [];
  for (let i = 0; i < 3; ++i)
    for (let j = 0; j < 3; ++j) out.push(a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]);
  return out.concat(move(a, b.slice(9)));
}

// Rotation by rows of a quaternion x, y, z, w of any length.
function rotationOf(q) {
  const [x, y, z, w] = scaled(q, 1 / Math.hypot(...q));
  return [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
          2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

// The motion of a joint: a turn by `angle` about a screw axis (w, v) without pitch; w x v is a point of it.
function aboutAxis(axis, angle) {
  const w = axis.slice(0, 3), v = axis.slice(3), point = cross(w, v), half = Math.sin(angle / 2);
  const rotation = rotationOf([...scaled(w, half), Math.cos(angle / 2)]);
  return rotation.concat(minus(point, turn(rotation, point)));
}

// Row of a table at any time: cubic between the rows, the slopes from their neighbors (chain::interpolate).
function rowAt(times, values, columns, time) {
  const count = times.length, row = k => Array.from(values.subarray(k * columns, (k + 1) * columns));
  if (count === 1) return row(0);
  const i = Math.min(lastNotAfter(times, time), count - 2);
  const h = times[i + 1] - times[i], u = Math.min(1, Math.max(0, (time - times[i]) / h));
  const slope = k => {
    const a = Math.max(k - 1, 0), b = Math.min(k + 1, count - 1);
    return scaled(minus(row(b), row(a)), h / (times[b] - times[a]));
  };
  const u2 = u * u, u3 = u2 * u, parts = [row(i), slope(i), row(i + 1), slope(i + 1)];
  const weights = [2 * u3 - 3 * u2 + 1, u3 - 2 * u2 + u, 3 * u2 - 2 * u3, u3 - u2];
  return parts[0].map((_, c) => parts.reduce((sum, part, k) => sum + weights[k] * part[c], 0));
}

// Index of the last of the increasing `times` that is not after `time`; 0 before the first.
function lastNotAfter(times, time) {
  let low = 0, high = times.length;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle; else high = middle;
  }
  return low;
}

// Whether a motion says where the rope is: one that was followed does not beyond its ends and where it was lost.
function isKnown({time: times, gap}, time) {
  if (gap === undefined) return true;
  const k = lastNotAfter(times, time);
  if (time < times[0] || k === times.length - 1) return Math.abs(time - times[k]) <= gap / 2;
  return time === times[k] || times[k + 1] - times[k] <= gap;
}

function basePose(motion, time) {
  const row = rowAt(motion.time, motion.base, 7, time);  // place, quaternion
  return rotationOf(row.slice(3)).concat(row.slice(0, 3));
}

// World poses that carry home coordinates of every link, base link first.
function linkMotions(chain, motion, time) {
  const theta = rowAt(motion.time, motion.theta, chain.axes.length, time), poses = [basePose(motion, time)];
  chain.axes.forEach((axis, k) => {
    const link = chain.child[k];
    poses[link] = compose(poses[link] || poses[link - 1], aboutAxis(axis, theta[k]));
  });
  return poses.map((pose, link) => pose.slice(0, 9).concat(move(pose, chain.lifts[link])));
}

// Those of the material, which rolls about the links' axes (chain::material_motions); straight lines between the rows.
function rolled(chain, motion, time, poses) {
  if (!motion.roll) return poses;
  const count = motion.time.length, links = poses.length, i = Math.max(0, Math.min(lastNotAfter(motion.time, time), count - 2));
  const span = motion.time[i + 1] - motion.time[i], u = count > 1 ? Math.min(1, Math.max(0, (time - motion.time[i]) / span)) : 0;
  const at = (row, link) => row < count ? motion.roll[row * links + link] : 0;
  const axis = [...chain.direction, 0, 0, 0];
  return poses.map((pose, link) => compose(pose, aboutAxis(axis, (1 - u) * at(i, link) + u * at(i + 1, link))));
}

// Grasp, joints and free end in the world.
function nodesOf(chain, poses) {
  const at = (link, arclength) => move(poses[link], scaled(chain.direction, arclength));
  return [at(0, 0), ...poses.slice(1).map((_, j) => at(j + 1, chain.starts[j + 1])), at(poses.length - 1, chain.length)];
}
