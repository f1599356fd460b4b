import * as THREE from 'three/webgpu';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { GLTFGaussianSplatLoaderExtension } from 'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js';

// Every link is a mesh of its own, sorted in itself only, and splats of one show through the next.
export async function start(canvas, url, view) {
  // drawn once and read later
  const context = canvas.getContext('webgl2', { preserveDrawingBuffer: true, antialias: false, alpha: true, depth: true, stencil: false });
  const renderer = new THREE.WebGPURenderer({ canvas, context, forceWebGL: true, antialias: false });
  // splats are trained in display values: blending them in linear light would change them
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.setPixelRatio(1);
  renderer.setSize(view.width, view.height, false);
  await renderer.init();
  const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const gltf = await loader.loadAsync(url);
  const scene = new THREE.Scene();
  scene.add(gltf.scene);
  const mixer = new THREE.AnimationMixer(gltf.scene);
  mixer.clipAction(gltf.animations[0]).play();
  const camera = new THREE.PerspectiveCamera();
  camera.updateProjectionMatrix = () => {
    camera.projectionMatrix.fromArray(view.projection);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  };
  camera.updateProjectionMatrix();
  new THREE.Matrix4().fromArray(view.world).decompose(camera.position, camera.quaternion, camera.scale);

  return async (time, white) => {
    mixer.setTime(time);
    renderer.setClearColor(white ? 0xffffff : 0x000000, 1);
    for (let frame = 0; frame < 5; ++frame) {  // the order of the splats is found beside the drawing
      await renderer.renderAsync(scene, camera);
      await new Promise((resolve) => setTimeout(resolve, 100));
    }
    await renderer.renderAsync(scene, camera);
    return canvas;
  };
}
