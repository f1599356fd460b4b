// Draws Gaussians on their links with the program's image model (docs/mathematics.md 2.4 to 2.6). Pose, covariance,
// color and order are found here in double; the device blends ten floats a splat into half floats, so that forty layers
// do not add up the rounding of 8 bits.

// Spherical harmonics in the order and with the signs of 3DGS, of a unit direction.
function harmonics(degree, x, y, z) {
  const out = [0.28209479177387814];
  if (degree > 0) out.push(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x);
  if (degree > 1)
    out.push(1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
             -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y));
  if (degree > 2)
    out.push(-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
             -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
             0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
             -0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
             -0.5900435899266435 * x * (x * x - 3 * y * y));
  return out;
}

const floatsPerSplat = 10;  // two half axes, center, color with opacity, which is negative where it is hatched
const hatch = 8;  // pixels from line to line, across what no camera saw

function compile(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, '#version 300 es\nprecision highp float;\n' + source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  return program;
}

// A function that draws, or null where there is no WebGL 2.
function makePainter(canvas, splats, model) {
  const gl = canvas.getContext('webgl2', {premultipliedAlpha: true, antialias: false});
  if (!gl) return null;
  const deep = gl.getExtension('EXT_color_buffer_float');  // else 8 bits have to do
  const reach = Math.sqrt(-2 * Math.log(model.leastAlpha)).toFixed(6);
  const blend = compile(gl, `
    layout(location = 0) in vec4 axes; layout(location = 1) in vec2 center; layout(location = 2) in vec4 color;
    uniform vec2 size; out vec2 place; out vec4 tone;
    void main() {
      place = ${reach} * (vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0);
      vec2 pixel = center + axes.xy * place.x + axes.zw * place.y;
      gl_Position = vec4(pixel / size * vec2(2, -2) + vec2(-1, 1), 0, 1);
      tone = color;
    }`, `
    in vec2 place; in vec4 tone; out vec4 result;
    void main() {
      float alpha = min(${model.mostAlpha}, abs(tone.a) * exp(-0.5 * dot(place, place)));
      if (alpha < ${model.leastAlpha}) discard;
      bool dark = tone.a < 0.0 && mod(gl_FragCoord.x + gl_FragCoord.y, ${hatch}.0) < ${hatch / 2}.0;
      result = vec4((dark ? 0.4 : 1.0) * tone.rgb * alpha, alpha);
    }`);
  const show = compile(gl, `
    void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1); }`, `
    uniform sampler2D sum; out vec4 result;
    void main() { result = clamp(texelFetch(sum, ivec2(gl_FragCoord.xy), 0), 0.0, 1.0); }`);
  const sizeAt = gl.getUniformLocation(blend, 'size'), buffer = gl.createBuffer(), array = gl.createVertexArray();
  const none = gl.createVertexArray(), texture = gl.createTexture(), frame = gl.createFramebuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  [[4, 0], [2, 4], [4, 6]].forEach(([count, first], place) => {
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, count, gl.FLOAT, false, 4 * floatsPerSplat, 4 * first);
    gl.vertexAttribDivisor(place, 1);
  });
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  const found = new Float32Array(splats.count * floatsPerSplat), sorted = new Float32Array(found.length);
  const depth = new Float64Array(splats.count), order = new Uint32Array(splats.count);
  let width = 0, height = 0;

  function target() {
    if (!deep) return gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    if (width === canvas.width && height === canvas.height) return;
    [width, height] = [canvas.width, canvas.height];
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  }

  return (camera, poses, tint, hatched) => {
    const scale = canvas.width / camera.width;  // of the canvas over the recorded picture
    let count = project(splats, camera, scale, poses, tint, hatched, model, found, depth);
    for (let i = 0; i < count; ++i) order[i] = i;
    order.subarray(0, count).sort((a, b) => depth[b] - depth[a]);
    for (let i = 0; i < count; ++i)
      for (let c = 0, a = i * floatsPerSplat, b = order[i] * floatsPerSplat; c < floatsPerSplat; ++c)
        sorted[a + c] = found[b + c];
    target();
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(blend);
    gl.bindVertexArray(array);
    gl.uniform2f(sizeAt, canvas.width, canvas.height);
    gl.bufferData(gl.ARRAY_BUFFER, sorted.subarray(0, count * floatsPerSplat), gl.STREAM_DRAW);
    gl.enable(gl.BLEND);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    gl.disable(gl.BLEND);
    if (!deep) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(show);
    gl.bindVertexArray(none);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 3);
  };
}

// How bright the side of the rope is that a Gaussian at `home` is on: a function of its link's pose.
function brightnessOf(light, least) {
  if (!light) return () => 1;
  const {axis, constant, linear, quadratic: q} = light;
  return (pose, home) => {
    const along = dot(home, axis), off = unit(home.map((x, k) => x - along * axis[k]));
    const n = minus(move(pose, off), pose.slice(9));
    const rows = [0, 3, 6].map(k => dot(q.slice(k, k + 3), n));
    return Math.max(least, constant + dot(linear, n) + dot(rows, n));
  };
}

// Fills `out` and `depth` with the splats in front of the camera and returns their number. Rows of J R_cw R_link are the
// image's axes seen in the home configuration, where the covariances are given.
function project(splats, camera, scale, poses, tint, hatched, model, out, depth) {
  const {values: s, stride, link, guessed, count, degree} = splats, view = camera.pose, terms = (degree + 1) ** 2;
  const fx = camera.fx * scale, fy = camera.fy * scale, cx = camera.cx * scale, cy = camera.cy * scale;
  const eye = view.slice(9), p = splats.pixelFootprint;
  const most = [model.clampMargin * 0.5 * camera.width / camera.fx, model.clampMargin * 0.5 * camera.height / camera.fy];
  const product = (o, a, b) => a[0] * (s[o] * b[0] + s[o + 1] * b[1] + s[o + 2] * b[2]) +
                               a[1] * (s[o + 1] * b[0] + s[o + 3] * b[1] + s[o + 4] * b[2]) +
                               a[2] * (s[o + 2] * b[0] + s[o + 4] * b[1] + s[o + 5] * b[2]);
  const brightness = brightnessOf(splats.light, model.leastBrightness);
  let n = 0;
  for (let i = 0; i < count; ++i) {
    const o = i * stride, pose = poses[link[i]], home = [s[o], s[o + 1], s[o + 2]], away = minus(move(pose, home), eye);
    const [x, y, z] = turnBack(view, away);
    if (z < model.near) continue;
    const bound = (v, limit) => Math.min(limit, Math.max(-limit, v));
    const jx = fx / z, jy = fy / z, kx = -jx * bound(x / z, most[0]), ky = -jy * bound(y / z, most[1]);
    const u = turnBack(pose, [jx * view[0] + kx * view[2], jx * view[3] + kx * view[5], jx * view[6] + kx * view[8]]);
    const v = turnBack(pose, [jy * view[1] + ky * view[2], jy * view[4] + ky * view[5], jy * view[7] + ky * view[8]]);
    const lowPass = j => model.lowPass * (p > 0 ? Math.max(model.leastFootprint * scale, p * j) : scale) ** 2;
    const a = product(o + 3, u, u) + lowPass(jx), b = product(o + 3, u, v), d = product(o + 3, v, v) + lowPass(jy);
    const middle = (a + d) / 2, radius = Math.hypot((a - d) / 2, b), angle = 0.5 * Math.atan2(2 * b, a - d);
    const long = Math.sqrt(middle + radius), short = Math.sqrt(Math.max(middle - radius, 1e-9));
    const c = Math.cos(angle), e = Math.sin(angle), at = n * floatsPerSplat;
    out[at] = c * long, out[at + 1] = e * long, out[at + 2] = -e * short, out[at + 3] = c * short;
    out[at + 4] = fx * x / z + cx, out[at + 5] = fy * y / z + cy;
    const seen = harmonics(degree, ...unit(turnBack(pose, away))), lit = brightness(pose, home);
    for (let channel = 0; channel < 3; ++channel) {
      let tone = 0.5;
      for (let t = 0; t < terms; ++t) tone += seen[t] * s[o + 10 + 3 * t + channel];
      tone *= lit;
      out[at + 6 + channel] = tint ? 0.35 * Math.max(0, tone) + 0.65 * tint[link[i] % tint.length][channel] : Math.max(0, tone);
    }
    out[at + 9] = hatched && guessed[i] ? -s[o + 9] : s[o + 9];
    depth[n++] = z;
  }
  return n;
}
