import * as pc from 'playcanvas';

// PlayCanvas lets a splat fall off to 0 at 2.83 standard deviations instead of as a Gaussian, which makes the rope some thirds
// of a pixel thinner. 'gaussian' takes that out, to show that nothing else differs.
export async function start(canvas, url, view, variant) {
  const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, alpha: false, preserveDrawingBuffer: true } });
  app.graphicsDevice.maxPixelRatio = 1;
  app.setCanvasFillMode(pc.FILLMODE_NONE, view.width, view.height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, view.width, view.height);
  app.autoRender = false;
  if (variant === 'gaussian') {
    const chunks = pc.ShaderChunks.get(app.graphicsDevice, pc.SHADERLANGUAGE_GLSL);
    chunks.set('gsplatPS', chunks.get('gsplatPS').replace('(exp(x * -4.0) - EXP4) * INV_EXP4', 'exp(x * -4.0)'));
  }
  app.start();
  const asset = new pc.Asset('twin', 'container', { url });
  await new Promise((resolve, reject) => {
    asset.once('load', resolve);
    asset.once('error', reject);
    app.assets.add(asset);
    app.assets.load(asset);
  });
  const entity = asset.resource.instantiateRenderEntity();
  app.root.addChild(entity);
  const track = asset.resource.animations[0].resource;
  entity.addComponent('anim', { activate: true, speed: 0 });
  entity.anim.assignAnimation('motion', track);
  const eye = new pc.Entity();
  eye.addComponent('camera', { fov: view.fovY * 180 / Math.PI, nearClip: view.near, farClip: view.far });
  eye.camera.calculateProjection = (matrix) => matrix.set(view.projection);
  const world = new pc.Mat4().set(view.world);
  eye.setPosition(world.getTranslation());
  eye.setRotation(new pc.Quat().setFromMat4(world));
  app.root.addChild(eye);
  return async (time, white) => {
    const shade = white ? 1 : 0;
    eye.camera.clearColor = new pc.Color(shade, shade, shade, 1);
    entity.anim.baseLayer.activeStateCurrentTime = time;
    for (let frame = 0; frame < 8; ++frame) {
      entity.anim.baseLayer.activeStateCurrentTime = time;
      app.renderNextFrame = true;
      await new Promise((resolve) => app.once('frameend', resolve));
      await new Promise((resolve) => setTimeout(resolve, 100));
    }
    app.renderNextFrame = true;
    await new Promise((resolve) => app.once('frameend', resolve));
    return canvas;
  };
}
