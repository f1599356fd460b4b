// The tables of the page. Whatever comes from files goes through textContent, so that names never become markup.

function element(tag, text, options = {}) {
  const out = document.createElement(tag);
  if (text !== undefined) out.textContent = text;
  return Object.assign(out, options);
}

// Cells are texts or elements. Every row but the head may have its own class.
function table(head, rows, className = '') {
  const out = element('table', undefined, {className}), box = element('div', undefined, {className: 'wide'});
  const line = (cells, tag) => {
    const row = element('tr');
    for (const cell of cells) {
      const made = element(tag);
      made.append(cell instanceof Node ? cell : String(cell));
      row.append(made);
    }
    return row;
  };
  if (head) out.createTHead().append(line(head, 'th'));
  const body = out.createTBody();
  for (const cells of rows) body.append(line(cells, 'td'));
  box.append(out);
  return box;
}

const note = text => element('span', text, {className: 'note'});
// `digits` significant ones, without exponents where the number is of ordinary size.
function figure(value, digits = 3) {
  if (value === null || value === undefined || !isFinite(value)) return '\u2013';
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(digits - 1)
    : value.toFixed(Math.max(0, Math.min(6, digits - 1 - Math.floor(Math.log10(size || 1)))));
}

// A button that shows a moment of a camera.
function lookButton(text, look) {
  return element('button', text, {className: 'look', onclick: look});
}

// "0.42 \u00b1 0.05 N at 2.40 s, 0.180 \u00b1 0.004 m from the grasp", with what friction at rest may hide.
function forceText({largest, unit}) {
  const {value, error, least, most, arclength, arclength_error: spread, time} = largest;
  const hidden = most > value + 2.01 * error || least < Math.max(0, value - 2.01 * error);  // more than two errors
  return withError(value, error) + ' ' + unit + (hidden ? ` (friction at rest leaves ${figure(least, 2)} to ${figure(most, 2)})` : '') +
    ` at ${time.toFixed(2)} s, ${spread > 0 ? withError(arclength, spread) : figure(arclength)} m from the grasp`;
}

// The error with two significant digits, the value with as many decimals.
function withError(value, error) {
  if (!(error > 1e-9 * Math.abs(value)) || !isFinite(error)) return figure(value);  // what was given is as exact
  const decimals = Math.max(0, Math.min(9, 1 - Math.floor(Math.log10(error))));
  return value.toFixed(decimals) + ' \u00b1 ' + error.toFixed(decimals);
}

function fillVerdict(box, report, look, lookAt) {
  const findings = report.verdict || [], doubts = findings.filter(f => !f.trusted);
  const [word, kind] = report.trusted === undefined ? ['not examined', 'doubt'] : !report.trusted ? ['do not trust this twin', 'bad']
    : findings.length ? ['trusted, with remarks', 'doubt'] : ['trusted', 'good'];
  box.append(element('h2', 'Verdict'), element('p', word, {className: 'word ' + kind}));
  const list = element('ul');
  for (const finding of [...doubts, ...findings.filter(f => f.trusted)]) {
    const line = element('li', finding.text + ' ');
    if (finding.frame >= 0) line.append(lookButton('frame ' + finding.frame, () => look(finding.subject, finding.frame)));
    list.append(line);
  }
  for (const camera of report.cameras) {
    const worst = worstFrame(report, camera.name);
    if (!worst) continue;
    const line = element('li', `${camera.name}: the ${worst.motion} twin fits worst at ${worst.time.toFixed(2)} s, overlap ${figure(worst.iou)} `);
    line.append(lookButton('look', () => look(camera.name, worst.frame, worst.motion)));
    list.append(line);
  }
  if (report.forces) {
    const {largest} = report.forces;
    const line = element('li', largest ? `Largest force from outside: ${forceText(report.forces)} ` : 'Nothing touched the rope while it was followed.');
    if (largest) line.append(lookButton('look', () => lookAt(largest.time, 'followed')));
    list.append(line);
  }
  const common = ['log_stiffness', 'log_damping', 'log_drag'], poor = (report.weak || []).filter(w => common.includes(w[0]));
  if (poor.length)
    list.append(element('li', 'The motion was too poor to tell ' + [...new Set(poor.map(w => w[0]))].join(', ') +
                        ': their errors are those of what was assumed beforehand.'));
  if (report.trusted === undefined) list.append(element('li', 'Cameras, clocks, grasp and size were taken as given.'));
  box.append(list);
}

function worstFrame(report, camera) {
  let worst = null;
  for (const motion of report.motions) {
    const frames = (motion.overlap || {})[camera];
    if (frames) frames.values.forEach((iou, k) => {
      if (!worst || iou < worst.iou) worst = {motion: motion.name, iou, time: frames.times[k], frame: frames.numbers[k]};
    });
  }
  return worst;
}

// What was followed and what pushed it, above and below the plot of the forces.
function fillFollowed(above, below, motion, forces, look) {
  const {time, gap, frames, own} = motion;
  let gaps = 0;
  for (let k = 1; k < time.length; ++k) gaps += time[k] - time[k - 1] > gap;
  above.append(element('p', `${frames} frames from ${time[0].toFixed(2)} to ${time[time.length - 1].toFixed(2)} s` +
    (gaps ? `, interrupted ${gaps === 1 ? 'once' : gaps + ' times'}` : '') +
    (own ? '.' : '; of another recording than the twin was made from, with a clock of its own.')));
  if (!forces) return;
  const line = element('p', forces.largest ? `Largest force from outside: ${forceText(forces)} ` : 'Nothing touched the rope.');
  if (forces.largest) line.append(lookButton('look', look));
  above.append(line);
  below.textContent = `Force from outside \u00b1 2 \u03c3${forces.hidden ? ' and what friction at rest may hide' : ''}, thick where something touches the rope, pale where nothing does. ` +
    `In the replay 10 cm of an arrow are ${figure(0.1 / forces.length, 2)} ${forces.unit}; around its head are 2 \u03c3` +
    (forces.hidden ? ', and it is dashed where friction at rest may hide a part.' : '.');
}

const metricColumns = [['psnr_object', 'object PSNR, dB', 1, 1], ['psnr', 'PSNR, dB', 1, 1], ['iou', 'overlap (IoU)', 1, 3],
                       ['ssim', 'SSIM', 1, 4], ['lpips', 'LPIPS', 1, 5], ['chamfer', 'Chamfer, mm', 1e3, 2],
                       ['centerline_rms', 'centerline, mm', 1e3, 2], ['tip_rms', 'tip, mm', 1e3, 2]];

function fillMetrics(box, report) {
  const known = report.motions.filter(motion => motion.metrics);
  if (!known.length) return;
  const columns = metricColumns.filter(([key]) => known.some(motion => key in motion.metrics.mean)), rows = [];
  for (const motion of known)
    for (const [name, values] of [...Object.entries(motion.metrics.cameras), ['all', motion.metrics.mean]])
      rows.push([`${motion.name}, ${name}`, ...columns.map(([key, , scale, digits]) => key in values ? (scale * values[key]).toFixed(digits) : '\u2013')]);
  box.append(element('h2', 'How well it explains the capture'), table(['', ...columns.map(c => c[1])], rows));
}

function fillIdentified(box, report) {
  if (!report.identified) return;
  box.append(element('h2', 'Identified'));
  if (!report.known_mass) box.append(element('p', 'The mass is not known: the total counts as 1 kg, forces are per kilogram of rope.', {className: 'legend'}));
  const rows = report.identified.map(q => [q.name, figure(q.value), q.error === null ? '' : '\u00b1 ' + figure(q.error, 2), q.unit, note(q.note)]);
  box.append(table(['', 'value', 'one \u03c3', 'unit', ''], rows, 'text'));
  const more = element('details'), raw = report.estimates;
  more.append(element('summary', `all ${raw.names.length} numbers of the fit`),
              table(['name', 'value', 'one \u03c3'], raw.names.map((name, i) => [name, figure(raw.values[i], 4), figure(raw.errors[i], 2)])));
  if (report.weak.length)
    more.append(table(['combinations of which the data tell less than what was assumed beforehand'], report.weak.map(w => [w.join(', ')]), 'text names'));
  if (raw.held.length) more.append(table(['held', 'why'], raw.held.map(h => [h.name, h.reason]), 'text'));
  box.append(more);
}

function fillCorrections(box, report) {
  const rows = [];
  const lines = (subject, quantities) => {
    for (const [name, q] of Object.entries(quantities))
      if (q && typeof q === 'object' && 'state' in q && q.state !== 'held')
        rows.push([`${subject}: ${name}`, [q.value].flat().map(v => figure(v)).join(', '), '\u00b1 ' + [q.sigma].flat().map(v => figure(v, 2)).join(', '), q.state]);
  };
  const {cameras = {}, ...rest} = report.corrections || {};
  for (const [name, quantities] of Object.entries(cameras)) lines(name, quantities);
  for (const [name, quantities] of Object.entries(rest)) lines(name, quantities);
  if (!rows.length) return;
  const more = element('details');
  more.append(element('summary', 'all of them, in rad, m, s and px; what was found is given + value'), table(['', 'value', 'one \u03c3', ''], rows, 'text'));
  box.append(element('h2', 'Corrections of the recording'), more);
}

function fillSeconds(box, report) {
  const rows = Object.entries(report.seconds).filter(([, s]) => s > 0).map(([stage, s]) => [stage, s.toFixed(2)]);
  if (!rows.length) return;
  const total = Object.values(report.seconds).reduce((a, b) => a + b, 0);
  box.append(element('h2', 'Time by stage, s'), table(null, [...rows, ['together', total.toFixed(2)]]));
}
