// Morph targets summed here instead of in the vertex shader, for WebGL without a graphics card: that goes through every target
// for every corner of every triangle, in software.

import * as THREE from "three";

export class ProcessorMorphing {
  #meshes = [];

  /** @param {THREE.Object3D} root whose meshes lose their morph targets; their influences stay what moves them. */
  constructor(root) {
    root.traverse((object) => {
      if (object.isMesh && object.morphTargetInfluences) this.#meshes.push(taken(object));
    });
  }

  /** Takes what the influences are now. */
  update() {
    for (const { influences, parts } of this.#meshes)
      for (const { attribute, rest, targets } of parts) {
        attribute.array.set(rest);
        targets.forEach((target, row) => influences[row] !== 0 && add(attribute.array, target, influences[row]));
        attribute.needsUpdate = true;
      }
  }
}

/** A geometry of its own without targets: several meshes may share one, each with other influences. */
function taken(mesh) {
  const shared = mesh.geometry, own = new THREE.BufferGeometry();
  own.setIndex(shared.index);
  for (const [name, attribute] of Object.entries(shared.attributes)) own.setAttribute(name, attribute);
  for (const { start, count, materialIndex } of shared.groups) own.addGroup(start, count, materialIndex);
  const parts = ["position", "normal"].filter((name) => shared.morphAttributes[name] && shared.attributes[name]).map((name) => {
    const rest = numbers(shared.attributes[name]);
    const attribute = new THREE.BufferAttribute(rest.slice(), 3).setUsage(THREE.DynamicDrawUsage);
    own.setAttribute(name, attribute);
    return { attribute, rest, targets: shared.morphAttributes[name].map(numbers) };
  });
  mesh.geometry = own;
  return { influences: mesh.morphTargetInfluences, parts };
}

/** The numbers of an attribute of three, however they lie in the file. */
function numbers(attribute) {
  if (attribute.array instanceof Float32Array && !attribute.isInterleavedBufferAttribute) return attribute.array;
  const found = new Float32Array(3 * attribute.count), point = new THREE.Vector3();
  for (let i = 0; i < attribute.count; i++) point.fromBufferAttribute(attribute, i).toArray(found, 3 * i);
  return found;
}

function add(sum, target, weight) {
  for (let i = 0; i < sum.length; i++) sum[i] += weight * target[i];
}
