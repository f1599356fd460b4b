// The page: reads the data, fills the tables, and redraws whenever something is chosen.

const at = id => document.getElementById(id);
const report = JSON.parse(at('data').textContent);
const bytes = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0)).buffer;
const floats = text => new Float32Array(bytes(text)), doubles = text => new Float64Array(bytes(text));
const radiansToDegrees = 180 / Math.PI;

function unpack() {
  const {chain, splats} = report;
  chain.axes = Array.from({length: chain.angles.length}, (_, k) => chain.screws.slice(6 * k, 6 * k + 6));
  if (splats) {
    splats.values = floats(splats.values);
    for (const name of ['link', 'guessed']) splats[name] = new Uint8Array(bytes(splats[name]));
  }
  for (const motion of report.motions) {
    motion.time = doubles(motion.time), motion.theta = floats(motion.theta), motion.base = floats(motion.base);
    motion.sigma = motion.sigma && floats(motion.sigma), motion.roll = motion.roll && floats(motion.roll);
    motion.apart = motion.own === false;  // of another recording, with another clock
    for (const frames of Object.values(motion.overlap || {}))
      frames.values = floats(frames.values), frames.times = doubles(frames.times), frames.numbers = new Int32Array(bytes(frames.numbers));
  }
  if (report.forces) {
    const {forces} = report;
    forces.time = doubles(forces.time), forces.values = floats(forces.values), forces.flags = new Uint8Array(bytes(forces.flags));
  }
  for (const camera of report.cameras) camera.times = doubles(camera.times);
  for (const video of report.videos) {
    video.times = doubles(video.times);
    video.pictures = video.frames.map(jpeg => {
      const picture = new Image();
      picture.src = 'data:image/jpeg;base64,' + jpeg;
      picture.onload = () => redraw();
      return picture;
    });
  }
}

unpack();
const {chain, motions} = report, up = unit(scaled(report.gravity, -1));
const followed = motions.find(m => m.name === 'followed');
const styles = {
  recognized: {color: 'first', line: 'dashed', dash: [4, 3]}, 'rolled out': {color: 'second', line: 'solid', dash: []},
  followed: {color: 'third', line: 'dotted', dash: [1.5, 2.5]},
};
// Those that have a clock in common with the chosen one, and the times that they cover.
const together = () => motions.filter(m => m.apart === motions[state.motion].apart);
let first = 0, last = 0;
const state = {time: -Infinity, motion: motions.length - 1, camera: -1, playing: false, links: false, line: false, axes: false,
               others: true, guessed: true, push: Boolean(report.forces), mode: 'off', plain: false, orbit: null};
const paint = report.splats && makePainter(at('splats'), report.splats, report.model);

function freshOrbit() {
  const motion = together()[0], halfway = (motion.time[0] + motion.time[motion.time.length - 1]) / 2;
  const nodes = nodesOf(chain, linkMotions(chain, motion, halfway));
  const middle = scaled(nodes.reduce(add), 1 / nodes.length);
  return {target: middle, distance: 1.8 * chain.length, yaw: 0.6, pitch: 0.2};
}

// Colors of the theme as the canvas needs them.
const probe = document.body.appendChild(element('span', '', {hidden: true}));
function ink(name) {
  probe.style.color = `var(--${name})`;
  return getComputedStyle(probe).color;
}
const motionInk = motion => ink(styles[motion.name].color);
const linkTints = [[0.9, 0.5, 0.2], [0.25, 0.6, 0.9]];
const axisInks = ['#e05a4f', '#4fae62', '#5a7fe0'];

const videoOf = () => state.camera < 0 || motions[state.motion].apart ? null : report.videos.find(v => v.camera === report.cameras[state.camera].name) || null;

// Canvases as large as the stage, or as the chosen camera's picture fits into it.
function layOut() {
  const stage = at('stage'), camera = report.cameras[state.camera], ratio = state.plain ? 1 : devicePixelRatio || 1;
  stage.classList.toggle('camera', Boolean(camera));
  let [w, h] = [stage.clientWidth, stage.clientHeight], [left, top] = [0, 0];
  if (camera) {
    const fit = state.plain ? 1 : Math.min(w / camera.width, h / camera.height);
    [left, top] = state.plain ? [0, 0] : [(w - fit * camera.width) / 2, (h - fit * camera.height) / 2];
    [w, h] = [fit * camera.width, fit * camera.height];
    stage.style.height = state.plain ? h + 'px' : '';
  }
  for (const id of ['video', 'splats', 'overlay']) {
    const canvas = at(id);
    Object.assign(canvas.style, {left: left + 'px', top: top + 'px', width: w + 'px', height: h + 'px'});
    canvas.width = Math.max(1, Math.round(w * ratio)), canvas.height = Math.max(1, Math.round(h * ratio));
  }
}

function drawVideo() {
  const canvas = at('video'), pen = canvas.getContext('2d'), video = videoOf(), {mode} = state;
  pen.clearRect(0, 0, canvas.width, canvas.height);
  const splats = at('splats').style;
  const shown = video && mode !== 'off';
  splats.clipPath = shown && mode === 'wipe' ? `inset(0 0 0 ${at('wipe').value}%)` : '';
  splats.background = shown && mode === 'wipe' ? '#000' : '';
  splats.mixBlendMode = shown && mode === 'difference' ? 'difference' : '';
  splats.visibility = shown && mode === 'outline' || !isKnown(motions[state.motion], state.time) ? 'hidden' : '';
  if (!shown) return;
  let k = 0;
  while (k < video.times.length - 1 && Math.abs(video.times[k + 1] - state.time) <= Math.abs(video.times[k] - state.time)) ++k;
  pen.globalAlpha = mode === 'dim' ? 0.45 : 1;
  if (video.pictures[k].complete) pen.drawImage(video.pictures[k], 0, 0, canvas.width, canvas.height);
}

// The force at the chosen time, where something touches the rope then.
function pushNow() {
  const {forces} = report, {apart} = motions[state.motion];
  if (!forces || !state.push || followed.apart !== apart) return null;
  let k = lastNotAfter(forces.time, state.time);
  if (k + 1 < forces.time.length && forces.time[k + 1] - state.time < state.time - forces.time[k]) ++k;
  if (Math.abs(forces.time[k] - state.time) > forces.gap / 2 || !(forces.flags[k] & 1)) return null;
  const row = Array.from(forces.values.subarray(16 * k, 16 * k + 16));
  return {point: row.slice(0, 3), force: row.slice(3, 6), covariance: row.slice(6, 12), size: row[12], error: row[13],
          moving: Boolean(forces.flags[k] & 2)};
}

function drawStage() {
  const canvas = at('overlay'), pen = canvas.getContext('2d'), chosen = report.cameras[state.camera];
  const camera = chosen || orbitCamera(state.orbit, up, canvas.width, canvas.height), scale = canvas.width / camera.width;
  const ratio = state.plain ? 1 : devicePixelRatio || 1, motion = motions[state.motion], poses = linkMotions(chain, motion, state.time);
  if (paint) paint(camera, rolled(chain, motion, state.time, poses), state.links ? linkTints : null, state.guessed && !state.plain);
  drawVideo();
  pen.clearRect(0, 0, canvas.width, canvas.height);
  if (state.plain) return;
  if (!chosen && state.others) {
    if (report.table) drawPlane(pen, camera, scale, report.table.point, report.table.normal, nodesOf(chain, poses)[0], ink('line'), ratio);
    const path = Array.from({length: motion.time.length}, (_, k) => Array.from(motion.base.subarray(7 * k, 7 * k + 3)));
    strokeLine(pen, camera, scale, path, ink('soft'), ratio, [3 * ratio, 3 * ratio]);
    for (const other of report.cameras) drawCamera(pen, camera, scale, other, ink('soft'), ratio);
  }
  if (state.mode === 'outline' && videoOf() && isKnown(motion, state.time)) drawOutline(pen, at('splats'), ink('accent'), ratio);
  if (state.line || !paint)
    for (const each of together())
      if (isKnown(each, state.time))
        drawCenterline(pen, camera, scale, nodesOf(chain, linkMotions(chain, each, state.time)), motionInk(each), ratio,
                       each === motion ? null : [5 * ratio, 4 * ratio]);
  if (state.axes && isKnown(motion, state.time)) drawAxes(pen, camera, scale, chain, poses, axisInks, ratio);
  const push = pushNow();
  if (push)
    drawForce(pen, camera, scale, push, report.forces.length, withError(push.size, push.error) + ' ' + report.forces.unit, ink('push'), ratio);
}

const columnOf = (values, count, k) => Float64Array.from({length: values.length / count}, (_, i) => values[i * count + k] * radiansToDegrees);

// Single angles are known much worse than the shape that they make together (neighbors' errors cancel): of many of them
// the bands would hide all curves.
const mostBands = 12;
const hasBand = motion => motion.sigma && (chain.angles.length <= mostBands || Number(at('angle').value) >= 0);

function angleCurves(motion) {
  const count = chain.angles.length, chosen = Number(at('angle').value), curves = [];
  for (let k = 0; k < count; ++k)
    if (chosen < 0 || chosen === k)
      curves.push({times: motion.time, values: columnOf(motion.theta, count, k), dash: styles[motion.name].dash, gap: motion.gap,
                   band: hasBand(motion) && columnOf(motion.sigma, count, k).map(s => 2 * s),
                   color: chosen < 0 ? `hsl(${300 * k / count} 60% 52%)` : motionInk(motion)});
  return curves;
}

function differenceCurves() {
  const [recognized, rolled] = ['recognized', 'rolled out'].map(name => together().find(m => m.name === name));
  if (!recognized || !rolled) return [];
  const all = angleCurves(rolled);
  return angleCurves(recognized).map((seen, k) => {
    const made = all[k], band = seen.band || made.band;
    const both = band && band.map((_, i) => Math.hypot(seen.band ? seen.band[i] : 0, made.band ? made.band[i] : 0));
    return {times: seen.times, values: made.values.map((v, i) => v - seen.values[i]), band: both, color: made.color};
  });
}

function overlapCurves() {
  const curves = [];
  for (const motion of motions)
    Object.values(motion.overlap || {}).forEach(frames => curves.push({times: frames.times, values: frames.values, color: motionInk(motion)}));
  return curves;
}

// Thick where something touches the rope, and pale where nothing does.
function forceCurves() {
  const {time: times, values, flags, gap} = report.forces, color = ink('push');
  const column = (c, all) => Float32Array.from(times, (_, k) => all || flags[k] & 1 ? values[16 * k + c] : NaN);
  return [{times, values: column(12, true), between: [column(14, true), column(15, true)], gap, color, shade: 0.06},
          {times, values: column(12), between: [column(14), column(15)], gap, color, width: 3, shade: 0.2}];
}

function drawPlots() {
  const colors = {soft: ink('soft'), line: ink('line'), ink: ink('ink')}, difference = differenceCurves();
  drawPlot(at('plot_angles'), together().flatMap(angleCurves), 'degrees', state.time, colors);
  at('plot_difference').hidden = at('legend_difference').hidden = !difference.length;
  drawPlot(at('plot_difference'), difference, 'degrees', state.time, colors);
  if (report.forces) drawPlot(at('plot_force'), forceCurves(), report.forces.unit, state.time, colors);
  drawPlot(at('plot_overlap'), overlapCurves(), 'IoU', state.time, colors);
}

let asked = false;
function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(drawNow);
}

function drawNow() {
  asked = false;
  drawStage();
  if (!state.plain) drawPlots();
  sayHint();
  at('clock').textContent = state.time.toFixed(2) + ' s';
  at('time').value = state.time;
  document.body.dataset.time = state.time;
}

function setTime(time) {
  state.time = Math.min(last, Math.max(first, time));
  redraw();
}

function press(group, chosen) {
  [...at(group).children].forEach((button, k) => button.setAttribute('aria-pressed', k === chosen));
}

function sayHint() {
  const camera = report.cameras[state.camera];
  at('hint').textContent = !isKnown(motions[state.motion], state.time) ? 'not followed at this time'
    : !paint ? 'This browser has no WebGL 2, or the twin no Gaussians: the centerlines alone.'
    : !camera ? 'drag to turn, wheel or pinch to come closer, shift-drag to move'
    : camera.distorted ? 'without the distortion of the lens' : '';
}

function setCamera(index) {
  state.camera = index;
  press('cameras', index + 1);
  at('behind').hidden = !videoOf();
  layOut();
  redraw();
}

function setMotion(index) {
  const other = motions[index].apart !== motions[state.motion].apart || state.time === -Infinity;
  state.motion = index;
  press('motions', index);
  at('behind').hidden = !videoOf();
  if (other) {
    const shown = together();
    first = Math.min(...shown.map(m => m.time[0])), last = Math.max(...shown.map(m => m.time[m.time.length - 1]));
    at('time').min = first, at('time').max = last;
    state.orbit = freshOrbit();
    setTime(state.time);
  }
  sayAngles();
  redraw();
}

function sayAngles() {
  const shown = together();
  legend('legend_angles', shown.map(m => [m.name + (hasBand(m) ? ' \u00b1 2 \u03c3' : ''), styles[m.name].color, styles[m.name].line]));
  if (shown.some(m => m.sigma && !hasBand(m))) at('legend_angles').append(' (a single angle has its \u00b1 2 \u03c3)');
  for (const m of shown.filter(m => !m.sigma)) at('legend_angles').append(` (no deviations of what is ${m.name} are known)`);
}

// A moment of a camera, by the names that findings and metrics use.
function look(subject, frame, motion) {
  const index = report.cameras.findIndex(c => c.name === subject), times = index < 0 ? motions[0].time : report.cameras[index].times;
  if (motion || motions[state.motion].apart) setMotion(motion ? motions.findIndex(m => m.name === motion) : 0);
  if (index >= 0) setCamera(index);
  setTime(times[Math.min(frame, times.length - 1)]);
  at('replay').scrollIntoView({block: 'nearest'});
}

function lookAt(time, motion) {
  setMotion(motions.findIndex(m => m.name === motion));
  setTime(time);
  at('replay').scrollIntoView({block: 'nearest'});
}

let before = 0;
function tick(now) {
  if (!state.playing) return;
  const passed = before ? Math.min(0.1, (now - before) / 1e3) * Number(at('speed').value) : 0;
  before = now;
  state.time = state.time + passed > last ? first : state.time + passed;
  if (!asked) drawNow();
  requestAnimationFrame(tick);
}

function play(on) {
  state.playing = on;
  before = 0;
  at('play').textContent = on ? '\u275a\u275a' : '\u25b6';
  at('play').setAttribute('aria-label', on ? 'pause' : 'play');
  if (on) requestAnimationFrame(tick);
}

function listen() {
  at('time').oninput = event => setTime(Number(event.target.value));
  at('play').onclick = () => play(!state.playing);
  at('angle').onchange = () => { sayAngles(); redraw(); };
  at('wipe').oninput = redraw;
  at('mode').onchange = event => {
    state.mode = event.target.value;
    at('wipe').hidden = state.mode !== 'wipe';
    redraw();
  };
  at('theme').onclick = () => {
    const dark = getComputedStyle(document.body).backgroundColor === 'rgb(20, 23, 27)';
    document.documentElement.dataset.theme = dark ? 'light' : 'dark';
    redraw();
  };
  addEventListener('resize', () => { layOut(); redraw(); });
  addEventListener('hashchange', followLink);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', redraw);
  addEventListener('keydown', event => {
    if (event.target.closest('input, select, button')) return;
    if (event.key === ' ') event.preventDefault(), play(!state.playing);
    if (event.key === 'ArrowLeft' || event.key === 'ArrowRight') setTime(state.time + (event.key === 'ArrowLeft' ? -1 : 1) / 30);
  });
  for (const [id, motion] of [['plot_angles', null], ['plot_difference', null], ['plot_overlap', motions[0]], ['plot_force', followed]])
    at(id).onpointerdown = at(id).onpointermove = event => {
      if (!event.buttons || !at(id).timeAt) return;
      if (motion && motion.apart !== motions[state.motion].apart) setMotion(motions.indexOf(motion));
      setTime(at(id).timeAt(event.offsetX));
    };
  listenToOrbit(at('stage'));
}

// One finger or the mouse turns, two fingers or the wheel come closer, shift or the right button moves.
function listenToOrbit(stage) {
  const fingers = new Map();
  const free = () => { if (state.camera >= 0) return false; redraw(); return true; };
  stage.onpointerdown = event => { fingers.set(event.pointerId, event); stage.setPointerCapture(event.pointerId); };
  stage.onpointerup = stage.onpointercancel = event => fingers.delete(event.pointerId);
  stage.oncontextmenu = event => event.preventDefault();
  stage.onpointermove = event => {
    const was = fingers.get(event.pointerId);
    if (!was || !free()) return;
    const dx = event.clientX - was.clientX, dy = event.clientY - was.clientY, {orbit} = state;
    const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY); };
    const distance = fingers.size === 2 ? apart() : 0;
    fingers.set(event.pointerId, event);
    if (fingers.size === 2) {
      orbit.distance *= distance / apart();
    } else if (event.shiftKey || event.buttons === 2) {
      const {pose, fx} = orbitCamera(orbit, up, stage.clientWidth, stage.clientHeight), by = orbit.distance / fx;
      orbit.target = add(orbit.target, turn(pose, [-dx * by, -dy * by, 0]));
    } else {
      orbit.yaw -= 0.008 * dx, orbit.pitch = Math.min(1.5, Math.max(-1.5, orbit.pitch + 0.008 * dy));
    }
  };
  stage.onwheel = event => {
    if (!free()) return;
    event.preventDefault();
    state.orbit.distance *= Math.exp(0.001 * event.deltaY);
  };
}

// #camera=NAME&time=S&motion=NAME&theme=dark&video=wipe&plain&play: a moment that one can link to.
function followLink() {
  const asks = new URLSearchParams(location.hash.slice(1));
  state.plain = asks.has('plain');
  document.body.classList.toggle('plain', state.plain);
  if (asks.has('theme')) document.documentElement.dataset.theme = asks.get('theme') === 'dark' ? 'dark' : 'light';
  const named = (list, name, otherwise) => { const k = list.findIndex(each => each.name === name); return k < 0 ? otherwise : k; };
  for (const layer of ['links', 'line', 'axes']) if (asks.has(layer)) toggles[layer](true);
  if (asks.has('video')) at('mode').value = state.mode = asks.get('video'), at('wipe').hidden = state.mode !== 'wipe';
  setMotion(named(motions, asks.get('motion'), state.motion));
  setCamera(named(report.cameras, asks.get('camera'), -1));
  setTime(asks.has('time') ? Number(asks.get('time')) || 0 : state.time);
  if (asks.has('play')) play(true);
}

// Entries: text, color of the theme, style of its line.
function legend(id, entries) {
  at(id).replaceChildren();
  for (const [text, color, line] of entries) {
    const mark = element('i');
    mark.style.borderColor = `var(--${color})`, mark.style.borderTopStyle = line;
    at(id).append(mark, text);
  }
}

const toggles = {};
function fill() {
  at('name').textContent = report.name || 'twin';
  document.title = (report.name || 'twin') + ' \u2013 chainsplat';
  const count = report.splats ? report.splats.gaussians + ' Gaussians, ' : '';
  at('about').textContent = `${report.scenario}, ${chain.length.toFixed(3)} m, ${count}${chain.angles.length} angles, ` +
    `${motions[0].time.length} frames; chainsplat ${report.version}, seed ${report.seed}${report.device ? ', ' + report.device : ''}`;
  ['free view', ...report.cameras.map(c => c.name)].forEach((name, k) => at('cameras').append(element('button', name, {onclick: () => setCamera(k - 1)})));
  motions.forEach((motion, k) => at('motions').append(element('button', motion.name, {onclick: () => setMotion(k)})));
  const layers = [['links', 'link colors'], ['line', 'centerlines'], ['axes', 'screw axes'], ['others', 'cameras and path']];
  if (report.splats && report.splats.guessed.includes(1)) layers.push(['guessed', 'hatch what no camera saw']);
  if (report.forces) layers.push(['push', 'forces']);
  for (const [key, name] of layers) {
    const button = element('button', name);
    toggles[key] = on => { state[key] = on; button.setAttribute('aria-pressed', on); redraw(); };
    button.onclick = () => toggles[key](!state[key]);
    toggles[key](state[key]);
    at('layers').append(button);
  }
  at('angle').append(element('option', 'all angles', {value: -1}), ...chain.angles.map((name, k) => element('option', name, {value: k})));
  const measured = motions.filter(m => m.overlap);
  legend('legend_overlap', measured.map(m => [m.name + ', a curve a camera', styles[m.name].color, 'solid']));
  at('overlap').hidden = !measured.length;
  at('followed').hidden = !followed;
  at('plot_force').hidden = !report.forces;
  if (followed) fillFollowed(at('about_followed'), at('legend_force'), followed, report.forces, () => lookAt(report.forces.largest.time, 'followed'));
  fillVerdict(at('verdict'), report, look, lookAt);
  fillMetrics(at('metrics'), report);
  fillIdentified(at('identified'), report);
  fillCorrections(at('corrections'), report);
  fillSeconds(at('seconds'), report);
}

fill();
listen();
followLink();
drawNow();
