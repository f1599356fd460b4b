// What report.sh puts at the end of a copy of the page: uses it as a person would, and leaves in the document what came
// out: pictures of every camera over black at the frames asked for, and what the controls did.
const checks = {};
const wait = seconds => new Promise(done => setTimeout(done, 1e3 * seconds));
// On a busy machine the page may come to its work late.
const soon = async test => {
  for (let k = 0; k < 20 && !test(); ++k) await wait(0.2);
  return test();
};

function picture(camera, frame, motion) {
  state.plain = true;
  setMotion(motion);
  setCamera(camera);
  state.time = report.cameras[camera].times[frame];
  drawNow();
  const paper = document.createElement('canvas'), pen = paper.getContext('2d');
  Object.assign(paper, {width: at('splats').width, height: at('splats').height});
  pen.fillRect(0, 0, paper.width, paper.height);
  pen.drawImage(at('splats'), 0, 0);
  const shot = element('i', paper.toDataURL('image/png'), {className: 'shot', hidden: true});
  shot.dataset.name = `${report.cameras[camera].name}/${String(frame).padStart(6, '0')}`;
  document.body.append(shot);
}

// The side that no camera saw is hatched, only on its layer.
function checkHatch() {
  if (!paint || !report.splats.guessed.includes(1)) return 'none';
  const {yaw} = state.orbit, splats = () => { drawNow(); return at('splats').toDataURL(); };
  const differs = [0, 1, 2, 3, 4, 5, 6, 7].some(eighth => {
    state.orbit.yaw = eighth * Math.PI / 4;
    toggles.guessed(false);
    const plain = splats();
    toggles.guessed(true);
    return splats() !== plain;
  });
  state.orbit.yaw = yaw;
  return differs;
}

// What was followed is shown, and a force only where something touches, only on its layer.
function checkFollowed() {
  const {forces} = report, overlay = () => { drawNow(); return at('overlay').toDataURL(); };
  at('motions').children[motions.indexOf(followed)].click();
  checks.followed = motions[state.motion] === followed && first === together().reduce((t, m) => Math.min(t, m.time[0]), Infinity) &&
    at('legend_angles').textContent.includes('followed \u00b1 2 \u03c3') && at('followed').offsetHeight > 0;
  checks.apart = followed.apart;
  setCamera(report.cameras.findIndex(camera => report.videos.some(video => video.camera === camera.name)));
  checks.videos = Boolean(videoOf());
  setCamera(-1);
  checks.about = at('about_followed').textContent;
  setTime(followed.time[followed.time.length - 1] + 2 * followed.gap);
  state.time = followed.time[followed.time.length - 1] + 2 * followed.gap;
  drawNow();
  checks.lost = followed.time.some((t, k) => k > 0 && t - followed.time[k - 1] > followed.gap && !isKnown(followed, t - followed.gap / 2));
  checks.beyond = at('splats').style.visibility === 'hidden' && at('hint').textContent === 'not followed at this time';
  if (!forces) return;
  const arrow = k => {
    setTime(forces.time[k]);
    toggles.push(true);
    const shown = overlay();
    toggles.push(false);
    const hidden = overlay();
    toggles.push(true);
    return shown !== hidden && overlay() === shown;
  };
  const touched = forces.flags.findIndex(flag => flag & 1);
  checks.arrow = touched < 0 ? 'none' : arrow(touched);
  checks.no_arrow = !arrow(forces.flags.findIndex(flag => !(flag & 1)));
  const {width, height} = at('plot_force'), {data} = at('plot_force').getContext('2d').getImageData(0, 0, width, height);
  let curve = 0;  // pixels of the forces' color, red and blue
  for (let i = 0; i < data.length; i += 4) curve += data[i + 3] > 100 && data[i] > data[i + 1] + 60 && data[i + 2] > data[i + 1] + 30;
  checks.plot = curve > width / 2;
  checks.largest = [...document.querySelectorAll('#verdict li')].map(line => line.textContent).find(text => text.includes('force'));
}

async function drive(frames) {
  if (paint) report.cameras.forEach((_, camera) => frames.forEach(frame => picture(camera, frame, motions.length - 1)));
  state.plain = false;
  setCamera(-1);
  // the slider
  at('time').value = (first + last) / 2;
  at('time').dispatchEvent(new Event('input'));
  checks.slider = await soon(() => Math.abs(Number(document.body.dataset.time) - (first + last) / 2) < 0.01);
  // play, and stop
  at('play').click();
  for (let k = 0; k < 6; ++k) tick(1000 + 40 * k);  // without a screen nobody says when frames are due
  at('play').click();
  const stopped = state.time;
  checks.play = Math.abs(stopped - (first + last) / 2 - 0.2) < 1e-6 && at('clock').textContent === stopped.toFixed(2) + ' s';
  await wait(0.2);
  checks.stop = state.time === stopped;
  // every button, every layer and every kind of video
  for (const button of document.querySelectorAll('.bar button:not(#play), .look, #theme')) button.click(), drawNow();
  for (const select of ['angle', 'mode', 'speed'])
    for (const option of at(select).options) at(select).value = option.value, at(select).dispatchEvent(new Event('change')), drawNow();
  // the free view turns and comes closer
  setCamera(-1);
  const {yaw, distance} = state.orbit, stage = at('stage');
  stage.setPointerCapture = () => {};
  const pointer = (kind, x) => stage.dispatchEvent(new PointerEvent(kind, {pointerId: 1, clientX: x, clientY: 50, buttons: 1}));
  pointer('pointerdown', 50), pointer('pointermove', 90), pointer('pointerup', 90);
  stage.dispatchEvent(new WheelEvent('wheel', {deltaY: 100, cancelable: true}));
  checks.orbit = state.orbit.yaw !== yaw && state.orbit.distance > distance;
  drawNow();
  checks.hatch = checkHatch();
  if (followed) checkFollowed();
  checks.width = document.documentElement.scrollWidth <= innerWidth;
  checks.images = document.images.length === 0;
  checks.title = document.title;
  checks.sections = [...document.querySelectorAll('main section')].filter(s => s.offsetHeight > 0).map(s => s.id).join();
  checks.errors = window.errors;
  document.body.dataset.checks = JSON.stringify(checks);
}
