// Wrinkle maps of a character that torchface has written: one normal map a shape, mixed as its shapes are while it moves.

import * as THREE from "three";

const AT_ONCE = 12; // the strongest shapes; WebGL promises 16 textures to a shader
const SHADER = `precision highp float;
in vec2 place;
out vec4 color;
uniform sampler2D rest, maps[${AT_ONCE}];
uniform float weights[${AT_ONCE}];
uniform bool flatRest;
// Slopes of heights add up, as in blend_normal_maps of torchface.
vec2 slope(vec4 texel) {
  vec3 normal = normalize(texel.xyz * 2.0 - 1.0);
  return normal.xy / max(normal.z, 0.02);
}
void main() {
  float still = 1.0;
  vec2 total = vec2(0.0);
${Array.from({ length: AT_ONCE }, (_, i) => `  if (weights[${i}] != 0.0) { total += weights[${i}] * slope(texture(maps[${i}], place)); still -= weights[${i}]; }`).join("\n")}
  if (!flatRest) total += still * slope(texture(rest, place));
  color = vec4(normalize(vec3(total, 1.0)) * 0.5 + 0.5, 1.0);
}`;
const CORNERS = "out vec2 place; void main() { place = uv; gl_Position = vec4(position.xy * 2.0, 0.0, 1.0); }";

/** The mixed maps of each mesh of a character that has such maps; reads them from the file. */
export async function wrinkleMaps(gltf, document) {
  const found = [];
  for (const [index, mesh] of (document.meshes ?? []).entries()) {
    const listed = mesh.extras?.torchface?.wrinkleMaps, names = mesh.extras?.targetNames ?? [];
    if (!Array.isArray(listed) || listed.length === 0) continue;
    const textures = await Promise.all(listed.map(({ texture }) => gltf.parser.getDependency("texture", texture)));
    const shapes = listed.map(({ shape }, i) => ({ row: names.indexOf(shape), texture: textures[i] })).filter(({ row }) => row >= 0);
    const objects = [];
    gltf.scene.traverse((object) => object.isMesh && gltf.parser.associations.get(object)?.meshes === index && objects.push(object));
    const skinned = objects.filter(({ material }) => material.normalMap), chosen = skinned.length ? skinned : objects.slice(0, 1);
    if (chosen.length && shapes.length) found.push(new MixedMap(chosen, shapes));
  }
  return found;
}

class MixedMap {
  #objects;
  #shapes;
  #target;
  #material;
  #picture;
  #camera = new THREE.Camera();
  #shown = null;

  constructor(objects, shapes) {
    [this.#objects, this.#shapes] = [objects, shapes];
    const rest = objects[0].material.normalMap, { width, height } = shapes[0].texture.image;
    this.#target = new THREE.WebGLRenderTarget(width, height, {
      depthBuffer: false, generateMipmaps: true, minFilter: THREE.LinearMipmapLinearFilter, wrapS: THREE.RepeatWrapping, wrapT: THREE.RepeatWrapping,
    });
    this.#material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: CORNERS, fragmentShader: SHADER, depthTest: false, depthWrite: false, toneMapped: false,
      uniforms: {
        rest: { value: rest ?? shapes[0].texture }, flatRest: { value: !rest },
        maps: { value: Array(AT_ONCE).fill(shapes[0].texture) }, weights: { value: Array(AT_ONCE).fill(0) },
      },
    });
    this.#picture = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), this.#material);
    this.#picture.frustumCulled = false;
  }

  /** Mixes the maps as the shapes are now, where these have changed. */
  update(renderer) {
    const influences = this.#objects[0].morphTargetInfluences;
    const active = this.#shapes.map(({ row, texture }) => ({ weight: influences[row], texture })).filter(({ weight }) => weight !== 0);
    const strongest = active.sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight)).slice(0, AT_ONCE);
    const now = strongest.map(({ weight, texture }) => `${texture.id}:${weight.toFixed(3)}`).join(" ");
    if (now === this.#shown) return;
    this.#shown = now;
    const { maps, weights } = this.#material.uniforms;
    for (let i = 0; i < AT_ONCE; i++) {
      weights.value[i] = strongest[i]?.weight ?? 0;
      maps.value[i] = strongest[i]?.texture ?? this.#shapes[0].texture;
    }
    renderer.setRenderTarget(this.#target);
    renderer.render(this.#picture, this.#camera);
    renderer.setRenderTarget(null);
    for (const { material } of this.#objects) {
      if (material.normalMap === this.#target.texture) continue;
      if (!material.normalMap) material.needsUpdate = true;
      material.normalMap = this.#target.texture;
    }
  }

  dispose() {
    this.#target.dispose();
    this.#material.dispose();
    this.#picture.geometry.dispose();
    for (const { texture } of this.#shapes) texture.dispose();
  }
}
