// Runs in the browser: lets one viewer draw /twin.glb from one of its cameras at some times of its animation, over black and
// over white, compares that with our pictures and sends the result. ?viewer=NAME[ VARIANT]&camera=INDEX&shots=FRAME@SECONDS,...
const query = new URLSearchParams(location.search);

// What a viewer needs of the camera: `world` and `projection`, 4 x 4 by columns, as OpenGL has them.
function cameraOf(glb) {
  const view = new DataView(glb);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(glb, 20, view.getUint32(12, true))));
  const index = Number(query.get('camera'));
  const node = json.nodes.find((each) => each.camera === index);
  const { fx, fy, cx, cy, width, height } = json.cameras[index].extras;
  const near = 0.01, far = 100;
  const projection = [
    2 * fx / width, 0, 0, 0,
    0, 2 * fy / height, 0, 0,
    1 - 2 * cx / width, 2 * cy / height - 1, -(far + near) / (far - near), -1,
    0, 0, -2 * far * near / (far - near), 0];
  // z_up turns the world's z to y: (x, y, z) -> (x, z, -y)
  const [x, y, z, w] = node.rotation;
  const columns = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
    [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
    [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
    node.translation];
  const world = columns.flatMap(([a, b, c], k) => [a, c, -b, k === 3 ? 1 : 0]);
  return { world, projection, width, height, fovY: 2 * Math.atan(0.5 * height / fy), near, far };
}

async function send(path, body) {
  await fetch(path, { method: 'POST', body });
}

async function pixels(url) {
  const picture = await createImageBitmap(await (await fetch(url)).blob(), { premultiplyAlpha: 'none' });
  const context = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
  context.drawImage(picture, 0, 0);
  return context.getImageData(0, 0, picture.width, picture.height).data;
}

// `ours` over black, and `mask`, 255 where it covers half or more; the viewer's over black and over white.
function compare(ours, mask, black, white) {
  let both = 0, either = 0, square = 0, count = 0;
  for (let i = 0; i < ours.length; i += 4) {
    let seen = 0;  // what of a white background shines through, of 3 * 255
    for (let c = 0; c < 3; ++c) seen += white[i + c] - black[i + c];
    const theirs = seen < 1.5 * 255, mine = mask[i] >= 128;
    both += theirs && mine;
    either += theirs || mine;
    if (mine) for (let c = 0; c < 3; ++c) square += (ours[i + c] - black[i + c]) ** 2, ++count;
  }
  return { iou: both / either, psnr: 10 * Math.log10(255 ** 2 / (square / count)) };
}

try {
  const glb = await (await fetch('/twin.glb')).arrayBuffer();
  const camera = cameraOf(glb);
  const canvas = document.getElementById('canvas');
  canvas.width = camera.width;
  canvas.height = camera.height;
  const [viewer, variant] = query.get('viewer').split(' ');
  const { start } = await import(`/${viewer}.mjs`);
  const draw = await start(canvas, '/twin.glb', camera, variant);
  const copy = new OffscreenCanvas(camera.width, camera.height);
  const context = copy.getContext('2d');
  const shots = query.get('shots').split(',').map((shot) => shot.split('@'));  // FRAME@TIME
  const results = [];
  for (const [frame, time] of shots) {
    const theirs = [];
    for (const white of [true, false]) {
      const drawn = await draw(Number(time), white);  // the canvas, right after it was drawn
      context.clearRect(0, 0, camera.width, camera.height);
      context.drawImage(drawn, 0, 0, camera.width, camera.height);
      theirs.push(context.getImageData(0, 0, camera.width, camera.height).data);
    }
    await send(`/picture/${frame}`, await copy.convertToBlob());
    results.push(compare(await pixels(`/frames/${frame}.png`), await pixels(`/frames/${frame}.mask.png`), theirs[1], theirs[0]));
  }
  await send('/done', JSON.stringify(results));
} catch (error) {
  await send('/failed', String((error && error.stack) || error));
}
