// A character made lighter for WebGL without a graphics card: its drawings are coarse, and the processor that solves makes them.

import * as THREE from "three";

const LARGEST = 1024; // texels a side: the first drawing waits for textures and for their mipmaps
const MATTE = 0.5; // roughness from which highlights are too faint to be missed
/** Between sRGB's numbers and light by polynomials, within 0.003: a processor decodes each of eight texels, and its powers take long. */
const QUICK = {
  map_fragment: `vec4 texel = texture2D(map, vMapUv);
    texel.rgb *= texel.rgb * (texel.rgb * 0.305306011 + 0.682171111) + 0.012522878;
    diffuseColor *= texel;`,
  colorspace_fragment: `vec3 light = clamp(gl_FragColor.rgb, 0.0, 1.0), root = sqrt(light), fourth = sqrt(root);
    gl_FragColor.rgb = 0.662002687 * root + 0.684122060 * fourth - 0.323583601 * sqrt(fourth) - 0.022541147 * light;`,
};

/**
 * Gives the materials of a character smaller pictures, and matte ones a simpler light without the surface's fine normals, which
 * takes half off a drawing; wrinkles that come and go stay. Colours of pictures are decoded by the shader.
 *
 * @param {THREE.Object3D} root whose materials are drawn as they are, by nothing that changes their shaders.
 */
export function lighten(root) {
  const simple = new Map(); // meshes share materials
  const glowing = new Set();
  root.traverse(({ material }) => [material ?? []].flat().forEach(({ emissiveMap }) => glowing.add(emissiveMap)));
  root.traverse((object) => {
    if (!object.isMesh) return;
    const lighter = (material) => simple.get(material) ?? simple.set(material, simpler(material)).get(material);
    object.material = Array.isArray(object.material) ? object.material.map(lighter) : lighter(object.material);
    for (const material of [object.material].flat())
      for (const value of Object.values(material)) if (value?.isTexture && !value.isCompressedTexture) shrink(value);
  });
  for (const material of simple.values()) if (material.map && !material.map.isCompressedTexture && !glowing.has(material.map)) quicken(material);
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

function quicken(material) {
  material.map.colorSpace = THREE.NoColorSpace;
  if (material.map.minFilter === THREE.LinearMipmapLinearFilter) material.map.minFilter = THREE.LinearMipmapNearestFilter;
  material.onBeforeCompile = (shader) => {
    for (const [name, code] of Object.entries(QUICK)) shader.fragmentShader = shader.fragmentShader.replace(`#include <${name}>`, code);
  };
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
