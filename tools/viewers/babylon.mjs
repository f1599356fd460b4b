async function script(source) {
  await new Promise((resolve, reject) => {
    const element = document.createElement('script');
    Object.assign(element, { src: source, onload: resolve, onerror: () => reject(new Error(source)) });
    document.head.append(element);
  });
}

// As loaded, every link is a mesh of its own, sorted in itself only, and splats of one show through the next. 'merged' puts
// them into one mesh whose parts move with the links.
export async function start(canvas, url, view, variant) {
  await script('/modules/babylonjs/babylon.js');
  await script('/modules/babylonjs-loaders/babylonjs.loaders.min.js');
  const BABYLON = globalThis.BABYLON;
  const engine = new BABYLON.Engine(canvas, false, { preserveDrawingBuffer: true, stencil: false });
  const scene = new BABYLON.Scene(engine);
  scene.useRightHandedSystem = true;
  await BABYLON.SceneLoader.AppendAsync('', url, scene, undefined, '.glb');
  if (variant === 'merged') {
    const links = scene.meshes.filter((each) => each.getClassName() === 'GaussianSplattingMesh');
    const whole = new BABYLON.GaussianSplattingCompoundMesh('twin', null, scene, true);
    for (const [k, part] of whole.addParts(links, false).entries()) {
      part.parent = links[k];
      part.position = BABYLON.Vector3.Zero();
      part.rotationQuaternion = BABYLON.Quaternion.Identity();
      part.scaling = BABYLON.Vector3.One();
      links[k].isVisible = false;
    }
  }
  const camera = new BABYLON.TargetCamera('eye', BABYLON.Vector3.Zero(), scene);
  camera.minZ = view.near;
  camera.maxZ = view.far;
  camera.fov = view.fovY;
  const world = BABYLON.Matrix.FromArray(view.world);
  const place = new BABYLON.Vector3(), turn = new BABYLON.Quaternion(), scale = new BABYLON.Vector3();
  world.decompose(scale, turn, place);
  camera.position = place;
  camera.rotationQuaternion = turn;
  camera.freezeProjectionMatrix(BABYLON.Matrix.FromArray(view.projection));
  scene.activeCamera = camera;
  const motion = scene.animationGroups[0];
  motion.start(true);
  motion.pause();
  return async (time, white) => {
    scene.clearColor = white ? new BABYLON.Color4(1, 1, 1, 1) : new BABYLON.Color4(0, 0, 0, 1);
    motion.goToFrame(motion.from + time * 60);  // the loader counts 60 frames a second
    for (let frame = 0; frame < 8; ++frame) {
      await scene.whenReadyAsync();
      scene.render();
      await new Promise((resolve) => setTimeout(resolve, 100));
    }
    scene.render();
    return canvas;
  };
}
