// A texture of three.js as the bytes of a PNG.

import * as THREE from "three";

/** None of a texture whose picture never came. */
export async function texturePng(texture) {
  if (texture.isCompressedTexture) return drawn(texture);
  const { image } = texture;
  if (!image?.width) return null;
  const canvas = new OffscreenCanvas(image.width, image.height);
  canvas.getContext("2d").drawImage(image, 0, 0);
  return bytes(canvas);
}

async function bytes(canvas) {
  return new Uint8Array(await (await canvas.convertToBlob({ type: "image/png" })).arrayBuffer());
}

/** What a graphics card makes of a compressed one. */
async function drawn(texture) {
  const { width, height } = texture.image, canvas = new OffscreenCanvas(width, height);
  const renderer = new THREE.WebGLRenderer({ canvas, alpha: true, premultipliedAlpha: false, preserveDrawingBuffer: true });
  const scene = new THREE.Scene(), camera = new THREE.OrthographicCamera(-1, 1, -1, 1); // a glTF's pictures begin above
  const material = new THREE.MeshBasicMaterial({ map: texture, transparent: true, blending: THREE.NoBlending });
  scene.add(new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material));
  camera.position.z = 1;
  material.side = THREE.DoubleSide;
  if (texture.colorSpace === THREE.NoColorSpace) renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.render(scene, camera);
  const png = await bytes(canvas);
  material.dispose();
  renderer.dispose();
  return png;
}
