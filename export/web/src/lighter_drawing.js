// A character made lighter for WebGL without a graphics card: its drawings are coarse, and the processor that solves makes them.

import * as THREE from "three";

const LARGEST = 1024; // texels a side: the first drawing waits for textures and for their mipmaps
const MATTE = 0.5; // roughness from which highlights are too faint to be missed

/**
 * Gives the materials of a character smaller pictures, and matte ones a simpler light without the surface's fine normals, which
 * takes half off a drawing; wrinkles that come and go stay.
 *
 * @param {THREE.Object3D} root whose materials are drawn as they are, by nothing that changes their shaders.
 */
export function lighten(root) {
  const simple = new Map(); // meshes share materials
  root.traverse((object) => {
    if (!object.isMesh) return;
    const lighter = (material) => simple.get(material) ?? simple.set(material, simpler(material)).get(material);
    object.material = Array.isArray(object.material) ? object.material.map(lighter) : lighter(object.material);
    for (const material of [object.material].flat())
      for (const value of Object.values(material)) if (value?.isTexture && !value.isCompressedTexture) shrink(value);
  });
}

/** Takes metal off: it shows what it reflects, and around the character there is nothing, so that it would be black. */
export function withoutMetal(root) {
  root.traverse(({ material }) => {
    for (const one of [material ?? []].flat()) if (one.metalness > 0) one.metalness = 0;
  });
}

function simpler(material) {
  if (material.type !== "MeshStandardMaterial" || material.metalness > 0 || material.roughness < MATTE) return material;
  const { name, color, map, normalMap, normalScale, aoMap, emissive, emissiveMap, emissiveIntensity } = material;
  const wrinkles = normalMap?.isRenderTargetTexture ? normalMap : null;
  const { alphaMap, alphaTest, transparent, opacity, side, depthWrite, vertexColors } = material;
  const matte = new THREE.MeshLambertMaterial({
    name, color, map, normalMap: wrinkles, normalScale, aoMap, emissive, emissiveMap, emissiveIntensity,
    alphaMap, alphaTest, transparent, opacity, side, depthWrite, vertexColors,
  });
  material.dispose();
  return matte;
}

function shrink(texture) {
  const { image } = texture, share = LARGEST / Math.max(image?.width, image?.height);
  if (!(share < 1)) return; // or a picture that never came
  const canvas = new OffscreenCanvas(Math.max(1, Math.round(share * image.width)), Math.max(1, Math.round(share * image.height)));
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  texture.image = canvas;
}
