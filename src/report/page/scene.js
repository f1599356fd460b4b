// What is drawn over the splats: centerlines, screw axes, cameras, the table, the path of the grasp, outlines.

// World point to canvas pixels and depth; null behind the camera.
function pixelOf(camera, scale, point) {
  const [x, y, z] = turnBack(camera.pose, minus(point, camera.pose.slice(9)));
  return z < 0.02 ? null : [scale * (camera.fx * x / z + camera.cx), scale * (camera.fy * y / z + camera.cy), z];
}

function strokeLine(pen, camera, scale, points, color, width, dash) {
  pen.strokeStyle = color;
  pen.lineWidth = width;
  pen.setLineDash(dash || []);
  pen.beginPath();
  let on = false;
  for (const point of points) {
    const at = pixelOf(camera, scale, point);
    if (at) on ? pen.lineTo(at[0], at[1]) : pen.moveTo(at[0], at[1]);
    on = at !== null;
  }
  pen.stroke();
  pen.setLineDash([]);
}

function drawCenterline(pen, camera, scale, nodes, color, ratio, dash) {
  strokeLine(pen, camera, scale, nodes, color, 2 * ratio, dash);
  pen.fillStyle = color;
  for (const node of nodes) {
    const at = pixelOf(camera, scale, node);
    if (!at) continue;
    pen.beginPath();
    pen.arc(at[0], at[1], 3 * ratio, 0, 7);
    pen.fill();
  }
}

// An ellipse that two standard deviations about a world point look like; `covariance` xx xy xz yy yz zz, m^2.
function drawSpread(pen, camera, scale, point, covariance, color, ratio) {
  const at = pixelOf(camera, scale, point), [x, y, z] = turnBack(camera.pose, minus(point, camera.pose.slice(9)));
  if (!at) return;
  const [xx, xy, xz, yy, yz, zz] = covariance, fx = scale * camera.fx / z, fy = scale * camera.fy / z;
  const times = v => [xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]];
  const u = turn(camera.pose, [fx, 0, -fx * x / z]), v = turn(camera.pose, [0, fy, -fy * y / z]);
  const a = dot(u, times(u)), b = dot(u, times(v)), d = dot(v, times(v));
  const middle = (a + d) / 2, radius = Math.hypot((a - d) / 2, b), root = w => 2 * Math.sqrt(Math.max(0, w));
  pen.beginPath();
  pen.ellipse(at[0], at[1], root(middle + radius), root(middle - radius), 0.5 * Math.atan2(2 * b, a - d), 0, 2 * Math.PI);
  pen.fillStyle = pen.strokeStyle = color;
  pen.globalAlpha = 0.14;
  pen.fill();
  pen.globalAlpha = 0.7;
  pen.lineWidth = ratio;
  pen.stroke();
  pen.globalAlpha = 1;
}

// A force: an arrow from where it acts, the spread of where its head may be, and how large it is. `length`: m a unit.
// Dashed where the rope rests and friction may hide a part of it.
function drawForce(pen, camera, scale, push, length, text, color, ratio) {
  const head = add(push.point, scaled(push.force, length)), from = pixelOf(camera, scale, push.point), to = pixelOf(camera, scale, head);
  if (!from || !to) return;
  drawSpread(pen, camera, scale, head, scaled(push.covariance, length * length), color, ratio);
  strokeLine(pen, camera, scale, [push.point, head], color, 3 * ratio, push.moving ? null : [6 * ratio, 4 * ratio]);
  const reach = Math.hypot(to[0] - from[0], to[1] - from[1]), size = Math.min(11 * ratio, 0.6 * reach);
  const along = reach > 0 ? [(to[0] - from[0]) / reach, (to[1] - from[1]) / reach] : [1, 0];
  pen.fillStyle = color;
  pen.beginPath();
  for (const [back, aside] of [[-0.2, 0], [1, 0.5], [1, -0.5]])
    pen.lineTo(to[0] - size * (back * along[0] - aside * along[1]), to[1] - size * (back * along[1] + aside * along[0]));
  pen.fill();
  pen.beginPath();
  pen.arc(from[0], from[1], 4 * ratio, 0, 7);
  pen.fill();
  pen.font = `600 ${13 * ratio}px sans-serif`;
  const room = pen.measureText(text).width, edge = 4 * ratio, aside = along[0] < 0 ? -room - 10 * ratio : 10 * ratio;
  pen.fillText(text, Math.max(edge, Math.min(pen.canvas.width - room - edge, to[0] + aside)), to[1] - 8 * ratio);
}

// Every joint's axes through its point, one color an axis of a joint.
function drawAxes(pen, camera, scale, chain, poses, colors, ratio) {
  const nodes = nodesOf(chain, poses), half = 1.5 * chain.diameter;
  chain.axes.forEach((axis, k) => {
    const link = chain.child[k], rank = chain.child.slice(0, k).filter(other => other === link).length;
    const along = turn(poses[link], axis.slice(0, 3)), at = nodes[link];
    strokeLine(pen, camera, scale, [add(at, scaled(along, -half)), add(at, scaled(along, half))], colors[rank % colors.length],
               1.5 * ratio);
  });
}

function drawCamera(pen, view, scale, camera, color, ratio) {
  const size = 0.06, corner = (x, y) => move(camera.pose, scaled([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1], size));
  const {width: w, height: h} = camera, corners = [corner(0, 0), corner(w, 0), corner(w, h), corner(0, h)];
  strokeLine(pen, view, scale, [...corners, corners[0]], color, ratio);
  for (const each of corners) strokeLine(pen, view, scale, [camera.pose.slice(9), each], color, ratio);
  const at = pixelOf(view, scale, camera.pose.slice(9));
  pen.fillStyle = color;
  pen.font = `${12 * ratio}px sans-serif`;
  if (at) pen.fillText(camera.name, at[0] + 6 * ratio, at[1] - 6 * ratio);
}

// A grid of 10 cm on the plane through `point`, around the foot of `center`.
function drawPlane(pen, view, scale, point, normal, center, color, ratio) {
  const across = unit(cross(normal, Math.abs(normal[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])), along = cross(normal, across);
  const foot = minus(center, scaled(normal, dot(normal, minus(center, point)))), reach = 5, cell = 0.1;
  for (let i = -reach; i <= reach; ++i)
    for (const [a, b] of [[across, along], [along, across]]) {
      const start = add(foot, scaled(a, i * cell)), end = scaled(b, reach * cell);
      strokeLine(pen, view, scale, [minus(start, end), add(start, end)], color, 0.7 * ratio);
    }
}

// The edge of what `canvas` shows: the picture shifted to all sides, less the picture.
function drawOutline(pen, canvas, color, ratio) {
  const paper = new OffscreenCanvas(canvas.width, canvas.height), draft = paper.getContext('2d');
  for (let i = 0; i < 8; ++i) draft.drawImage(canvas, 1.5 * ratio * Math.cos(i * Math.PI / 4), 1.5 * ratio * Math.sin(i * Math.PI / 4));
  draft.globalCompositeOperation = 'source-in';
  draft.fillStyle = color;
  draft.fillRect(0, 0, paper.width, paper.height);
  draft.globalCompositeOperation = 'destination-out';
  draft.drawImage(canvas, 0, 0);
  pen.drawImage(paper, 0, 0);
}

// A camera that looks at `orbit.target` from all sides; up is against gravity.
function orbitCamera(orbit, up, width, height) {
  const east = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])), north = cross(up, east);
  const level = add(scaled(east, Math.cos(orbit.yaw)), scaled(north, Math.sin(orbit.yaw)));
  const back = add(scaled(level, Math.cos(orbit.pitch)), scaled(up, Math.sin(orbit.pitch)));
  const z = scaled(back, -1), x = unit(cross(z, up)), y = cross(z, x), focal = 1.2 * Math.min(width, height);
  const eye = add(orbit.target, scaled(back, orbit.distance));
  return {name: '', width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2,
          pose: [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2], ...eye]};
}
