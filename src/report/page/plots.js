// Curves over time on a canvas: { times, values, band, color, dash, gap, width, shade } each, bands of two standard
// deviations around them, or what is `between` [low, high]. What is no number and steps in time that are longer than the
// gap interrupt curves and bands.

function drawPlot(canvas, curves, unit, cursor, colors) {
  const ratio = devicePixelRatio || 1, pen = canvas.getContext('2d');
  const width = canvas.width = Math.round(canvas.clientWidth * ratio), height = canvas.height = Math.round(canvas.clientHeight * ratio);
  const left = 46 * ratio, bottom = height - 18 * ratio, top = 8 * ratio, right = width - 6 * ratio;
  let [start, end, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const {times, values, band, between} of curves) {
    for (const bound of between || [])
      for (const v of extent(bound)) low = Math.min(low, v), high = Math.max(high, v);
    start = Math.min(start, times[0]), end = Math.max(end, times[times.length - 1]);
    values.forEach((v, k) => {
      const b = band && isFinite(band[k]) ? band[k] : 0;
      if (isFinite(v)) low = Math.min(low, v - b), high = Math.max(high, v + b);
    });
  }
  if (!(high >= low)) return;
  if (high - low < 1e-9) high += 0.5, low -= 0.5;
  const x = t => left + (t - start) / (end - start || 1) * (right - left);
  const y = v => bottom - (v - low) / (high - low) * (bottom - top);
  pen.font = `${11 * ratio}px sans-serif`;
  pen.fillStyle = colors.soft;
  pen.strokeStyle = colors.line;
  pen.lineWidth = ratio;
  const step = niceStep((high - low) / 3);
  pen.textAlign = 'right';
  for (let v = Math.ceil(low / step) * step; v <= high; v += step) {
    pen.beginPath();
    pen.moveTo(left, y(v));
    pen.lineTo(right, y(v));
    pen.stroke();
    pen.fillText(v.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))), left - 4 * ratio, y(v) + 4 * ratio);
  }
  const tick = niceStep((end - start) / 6);
  pen.textAlign = 'center';
  for (let t = Math.ceil(start / tick) * tick; t <= end + 1e-9; t += tick)
    pen.fillText(t.toFixed(Math.max(0, -Math.floor(Math.log10(tick) + 1e-9))), x(t), height - 4 * ratio);
  pen.textAlign = 'left';
  pen.fillText(unit, left + 4 * ratio, top + 10 * ratio);
  for (const curve of curves) drawCurve(pen, curve, x, y, ratio);
  pen.fillStyle = colors.ink;
  if (cursor >= start && cursor <= end) pen.fillRect(Math.round(x(cursor)), top, ratio, bottom - top);
  canvas.timeAt = place => start + (place * ratio - left) / (right - left) * (end - start);
}

// Least and largest finite number, without a limit on how many there are; nothing where none is finite.
function extent(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const v of values) if (isFinite(v)) low = Math.min(low, v), high = Math.max(high, v);
  return low <= high ? [low, high] : [];
}

function drawCurve(pen, {times, values, band, between, color, dash, gap = Infinity, width = 1.3, shade = 0.16}, x, y, ratio) {
  pen.fillStyle = pen.strokeStyle = color;
  if (band || between) {
    const low = k => between ? between[0][k] : values[k] - band[k], high = k => between ? between[1][k] : values[k] + band[k];
    const known = k => isFinite(high(k) - low(k));
    pen.globalAlpha = shade;
    for (let begin = 0, end; begin < times.length; begin = end) {
      for (end = begin + 1; end < times.length && times[end] - times[end - 1] <= gap && known(end) === known(begin);) ++end;
      if (!known(begin)) continue;
      pen.beginPath();
      for (let k = begin; k < end; ++k) pen.lineTo(x(times[k]), y(high(k)));
      for (let k = end - 1; k >= begin; --k) pen.lineTo(x(times[k]), y(low(k)));
      pen.fill();
    }
    pen.globalAlpha = 1;
  }
  pen.lineWidth = width * ratio;
  pen.setLineDash((dash || []).map(length => length * ratio));
  pen.beginPath();
  let on = false;
  for (let k = 0; k < times.length; ++k) {
    const there = isFinite(values[k]);
    if (k > 0 && times[k] - times[k - 1] > gap) on = false;
    if (there) on ? pen.lineTo(x(times[k]), y(values[k])) : pen.moveTo(x(times[k]), y(values[k]));
    on = there;
  }
  pen.stroke();
  pen.setLineDash([]);
}

// 1, 2 or 5 times a power of ten, at least `rough`.
function niceStep(rough) {
  const power = 10 ** Math.floor(Math.log10(rough)), part = rough / power;
  return (part > 5 ? 10 : part > 2 ? 5 : part > 1 ? 2 : 1) * power;
}
