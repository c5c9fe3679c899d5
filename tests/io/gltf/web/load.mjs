// three.js' loader: prints what a viewer sees of a .glb, as JSON.
// node load.mjs FILE WEIGHTS...  sets the morph weights and gives the moved positions of every vertex.
import { readFile } from "node:fs/promises";

// The loader decodes pictures by what browsers have; node has no pictures.
globalThis.self = globalThis;
let pictures = 0;
globalThis.createImageBitmap = async (blob) => {
  pictures += 1;
  return { width: 1, height: 1, size: blob.size, close() {} };
};

const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
const THREE = await import("three");

const bytes = await readFile(process.argv[2]);
const weights = process.argv.slice(3).map(Number);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new GLTFLoader().parseAsync(buffer, "");

const meshes = [];
gltf.scene.updateMatrixWorld(true);
gltf.scene.traverse((object) => {
  if (!object.isMesh) return;
  weights.forEach((weight, i) => (object.morphTargetInfluences[i] = weight));
  const positions = [];
  const point = new THREE.Vector3();
  for (let i = 0; i < object.geometry.attributes.position.count; i++) {
    object.getVertexPosition(i, point).applyMatrix4(object.matrixWorld);
    positions.push(point.x, point.y, point.z);
  }
  meshes.push({
    names: Object.entries(object.morphTargetDictionary ?? {}).sort((a, b) => a[1] - b[1]).map((entry) => entry[0]),
    attributes: Object.keys(object.geometry.attributes),
    indices: Array.from(object.geometry.index.array),
    positions,
    textured: object.material.map !== null,
    normalMapped: object.material.normalMap !== null,
    extras: object.userData.torchface ?? object.geometry.userData.torchface ?? null,
  });
});

const animations = gltf.animations.map((clip) => ({ duration: clip.duration, tracks: clip.tracks.length }));
let halfway = null;
if (gltf.animations.length > 0) {
  const mixer = new THREE.AnimationMixer(gltf.scene);
  mixer.clipAction(gltf.animations[0]).play();
  mixer.setTime(gltf.animations[0].duration / 2);
  gltf.scene.traverse((object) => {
    if (object.isMesh) halfway = Array.from(object.morphTargetInfluences);
  });
}
console.log(JSON.stringify({ meshes, animations, halfway, pictures }));
