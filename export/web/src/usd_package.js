// A take on a character as .usdz: meshes with their blend shapes, skeleton, skins, materials and textures, and the animation.

import * as THREE from "three";

import { weightOf } from "./arkit_names.js";
import { texturePng } from "./texture_png.js";
import { zipArchive } from "./zip_archive.js";

const ROOT = "/Character", SKELETON = `${ROOT}/Skeleton`, ANIMATION = `${ROOT}/Animation`, MATERIALS = `${ROOT}/Materials`;
const SAME = 1e-4; // of two matrices of one bone
const STILL = 1e-7; // metres: a vertex that a shape moves less is left out
const WRAPS = { [THREE.RepeatWrapping]: "repeat", [THREE.ClampToEdgeWrapping]: "clamp", [THREE.MirroredRepeatWrapping]: "mirror" };
const MAPS = [ // of three's materials: UsdPreviewSurface's input, the texture's output, and whether it holds colours
  ["map", "diffuseColor", "rgb", true], ["normalMap", "normal", "rgb", false], ["emissiveMap", "emissiveColor", "rgb", true],
  ["roughnessMap", "roughness", "g", false], ["metalnessMap", "metallic", "b", false],
];

const digits = (value) => String(Number(value.toPrecision(7)));
const tuple = (values) => `(${values.map(digits).join(", ")})`;
const tuples = (array, size) => list(Array.from({ length: Math.floor(array.length / size) }, (_, i) => tuple(Array.from(array.slice(size * i, size * i + size)))));
const list = (items) => `[${items.join(", ")}]`;
const quoted = (name) => JSON.stringify(name);
const matrix = ({ elements }) => `(${[0, 4, 8, 12].map((at) => tuple(elements.slice(at, at + 4))).join(", ")})`; // by rows, vectors on the left
const prim = (kind, name, schemas, lines) =>
  `def ${kind} ${quoted(name)}${schemas.length ? ` (prepend apiSchemas = ${list(schemas.map(quoted))})` : ""}\n{\n${lines.flat(9).join("\n")}\n}`;
const samples = (take, row) => `{\n${take.frames.map((frame, i) => `${digits(frame.seconds * take.rate)}: ${row(frame, i)},`).join("\n")}\n}`;

/**
 * @param {Character} character of its own, which nothing else poses.
 * @param {Take} take at least one frame.
 * @returns {Promise<Blob>}
 */
export async function usdPackage(character, take) {
  const joints = new Joints(character.root), images = [], materials = new Map(), meshes = [];
  const shapes = new Map(); // what drives each blend shape, by its token
  const found = [];
  character.root.traverse((object) => object.isMesh && found.push(object));
  for (const mesh of found) {
    const material = [mesh.material].flat()[0];
    if (!materials.has(material)) materials.set(material, await materialPrim(material, materials.size, images));
    meshes.push(meshPrim(mesh, `mesh_${meshes.length}`, `mat_${[...materials.keys()].indexOf(material)}`, joints, character.shapesOf(mesh), shapes));
  }
  const text = [
    `#usda 1.0\n(\ndefaultPrim = "Character"\nmetersPerUnit = 1\nupAxis = "Y"\ntimeCodesPerSecond = ${digits(take.rate)}\nframesPerSecond = ${digits(take.rate)}`,
    `startTimeCode = 0\nendTimeCode = ${digits(take.duration * take.rate)}\n)`,
    prim("SkelRoot", "Character", [], [joints.prim(), animationPrim(character, take, joints, shapes), meshes, prim("Scope", "Materials", [], [...materials.values()])]),
  ].join("\n");
  return zipArchive([["character.usda", new TextEncoder().encode(text)], ...images]);
}

/** The nodes of the scene as joints; a bone that two skins bind differently is one for each. */
class Joints {
  #all = [];
  #of = new Map();

  constructor(root) {
    root.updateWorldMatrix(true, true);
    root.traverse((object) => {
      const above = object === root ? "" : `${this.#of.get(object.parent)[0].path}/`;
      this.#add(object, `${above}${identifier(object.name, "node")}`, object.matrixWorld.clone(), object.matrix.clone());
    });
    root.traverse((object) => object.isSkinnedMesh && object.skeleton.bones.forEach((bone, i) => (this.#of.get(bone)[0].bind = object.skeleton.boneInverses[i].clone().invert())));
  }

  #add(object, path, bind, rest) {
    while (this.#all.some((one) => one.path === path)) path += "_";
    const joint = { path, bind, rest, index: this.#all.length };
    this.#all.push(joint);
    this.#of.set(object, [...(this.#of.get(object) ?? []), joint]);
    return joint;
  }

  path(object) {
    return this.#of.get(object)[0].path;
  }

  /** The joint of a node whose place at rest is `bind`. */
  joint(object, bind = null) {
    const known = this.#of.get(object);
    if (bind === null) return known[0];
    const same = known.find((one) => one.bind.elements.every((value, i) => Math.abs(value - bind.elements[i]) < SAME));
    return same ?? this.#add(object, `${known[0].path}/skin`, bind, new THREE.Matrix4());
  }

  prim() {
    return prim("Skeleton", "Skeleton", ["SkelBindingAPI"], [
      `uniform token[] joints = ${list(this.#all.map(({ path }) => quoted(path)))}`,
      `uniform matrix4d[] bindTransforms = ${list(this.#all.map(({ bind }) => matrix(bind)))}`,
      `uniform matrix4d[] restTransforms = ${list(this.#all.map(({ rest }) => matrix(rest)))}`,
      `rel skel:animationSource = <${ANIMATION}>`,
    ]);
  }
}

function animationPrim(character, take, joints, shapes) {
  const turned = character.turnedNodes(take), tokens = [...shapes.keys()];
  const order = ({ x, y, z, w }) => tuple([w, x, y, z]); // USD has the real part first
  return prim("SkelAnimation", "Animation", [], [
    `uniform token[] joints = ${list(turned.map(({ object }) => quoted(joints.path(object))))}`,
    `float3[] translations = ${list(turned.map(({ object }) => tuple(object.position.toArray())))}`,
    `half3[] scales = ${list(turned.map(({ object }) => tuple(object.scale.toArray())))}`,
    `quatf[] rotations.timeSamples = ${samples(take, (_, i) => list(turned.map(({ quaternions }) => order(new THREE.Quaternion(...quaternions[i])))))}`,
    `uniform token[] blendShapes = ${list(tokens.map(quoted))}`,
    `float[] blendShapeWeights.timeSamples = ${samples(take, ({ weights }) => list(tokens.map((token) => digits(weightOf(shapes.get(token), weights)))))}`,
  ]);
}

function meshPrim(mesh, name, material, joints, shapes, all) {
  const { attributes, index, morphAttributes } = mesh.geometry, path = `${ROOT}/${name}`;
  const position = numbers(attributes.position, 3), count = attributes.position.count;
  const corners = index ? Array.from(index.array) : Array.from({ length: count }, (_, i) => i);
  const map = [mesh.material].flat()[0].map, uv = attributes[map?.channel ? `uv${map.channel}` : "uv"];
  const targets = shapes.flatMap(([row, shape]) => {
    const moved = blendShape(mesh, row), token = identifier(shape.name, "shape");
    if (moved === null) return [];
    all.set(token, shape);
    return [[token, moved]];
  });
  const lines = [
    `int[] faceVertexCounts = ${list(new Array(corners.length / 3).fill(3))}`,
    `int[] faceVertexIndices = ${list(corners)}`,
    `point3f[] points = ${tuples(position, 3)}`,
    'uniform token subdivisionScheme = "none"',
    `uniform bool doubleSided = ${[mesh.material].flat()[0].side === THREE.DoubleSide ? 1 : 0}`,
    `rel material:binding = <${MATERIALS}/${material}>`,
    `rel skel:skeleton = <${SKELETON}>`,
  ];
  if (attributes.normal) lines.push(`normal3f[] normals = ${tuples(numbers(attributes.normal, 3), 3)} (interpolation = "vertex")`);
  if (uv) lines.push(`texCoord2f[] primvars:st = ${tuples(placed(numbers(uv, 2), map), 2)} (interpolation = "vertex")`);
  lines.push(...binding(mesh, joints));
  if (targets.length > 0) {
    lines.push(`uniform token[] skel:blendShapes = ${list(targets.map(([token]) => quoted(token)))}`);
    lines.push(`rel skel:blendShapeTargets = ${list(targets.map(([token]) => `<${path}/${token}>`))}`);
    lines.push(...targets.map(([token, { rows, offsets, normals }]) => prim("BlendShape", token, [], [
      `uniform int[] pointIndices = ${list(rows)}`,
      `uniform vector3f[] offsets = ${tuples(offsets, 3)}`,
      normals ? `uniform vector3f[] normalOffsets = ${tuples(normals, 3)}` : [],
    ])));
  }
  return prim("Mesh", name, ["SkelBindingAPI", "MaterialBindingAPI"], lines);
}

/** By which joints the vertices move: those of the skin, or the mesh's own. */
function binding(mesh, joints) {
  if (!mesh.isSkinnedMesh) {
    const { index, bind } = joints.joint(mesh);
    return [
      `int[] primvars:skel:jointIndices = [${index}] (elementSize = 1\ninterpolation = "constant")`,
      `float[] primvars:skel:jointWeights = [1] (elementSize = 1\ninterpolation = "constant")`,
      `uniform matrix4d primvars:skel:geomBindTransform = ${matrix(bind)}`,
    ];
  }
  const { bones, boneInverses } = mesh.skeleton, { skinIndex, skinWeight } = mesh.geometry.attributes;
  const indices = bones.map((bone, i) => joints.joint(bone, boneInverses[i].clone().invert()).index);
  return [
    `int[] primvars:skel:jointIndices = ${list(numbers(skinIndex, 4).map((bone) => indices[bone]))} (elementSize = 4\ninterpolation = "vertex")`,
    `float[] primvars:skel:jointWeights = ${list(Array.from(numbers(skinWeight, 4), digits))} (elementSize = 4\ninterpolation = "vertex")`,
    `uniform matrix4d primvars:skel:geomBindTransform = ${matrix(mesh.bindMatrix)}`,
  ];
}

function blendShape({ geometry: { morphAttributes } }, row) {
  const [moved, turned] = ["position", "normal"].map((name) => morphAttributes[name]?.[row] && numbers(morphAttributes[name][row], 3));
  if (!moved) return null;
  const rows = [];
  for (let i = 0; i < moved.length / 3; i++) if (Math.hypot(...moved.slice(3 * i, 3 * i + 3)) > STILL) rows.push(i);
  const of = (values) => rows.flatMap((i) => Array.from(values.slice(3 * i, 3 * i + 3)));
  return rows.length === 0 ? null : { rows, offsets: of(moved), normals: turned ? of(turned) : null };
}

/** Texture coordinates from the lower left, moved as the texture says. */
function placed(uv, map) {
  const point = new THREE.Vector2();
  map?.updateMatrix();
  for (let i = 0; i < uv.length; i += 2) {
    point.set(uv[i], uv[i + 1]);
    if (map) point.applyMatrix3(map.matrix);
    [uv[i], uv[i + 1]] = [point.x, 1 - point.y];
  }
  return uv;
}

async function materialPrim(material, number, images) {
  const name = `mat_${number}`, path = `${MATERIALS}/${name}`, shaders = [];
  const inputs = {
    diffuseColor: `color3f inputs:diffuseColor = ${tuple((material.color ?? new THREE.Color(1, 1, 1)).toArray())}`,
    emissiveColor: `color3f inputs:emissiveColor = ${tuple((material.emissive ?? new THREE.Color(0, 0, 0)).toArray())}`,
    roughness: `float inputs:roughness = ${digits(material.roughness ?? 1)}`,
    metallic: `float inputs:metallic = ${digits(material.metalness ?? 0)}`,
    opacity: `float inputs:opacity = ${digits(material.opacity)}`,
  };
  for (const [field, input, output, colored] of MAPS) {
    const texture = material[field];
    if (!texture) continue;
    if (!images.some(([, , source]) => source === texture.source)) {
      const png = await texturePng(texture);
      if (png === null) continue;
      images.push([`textures/${images.length}.png`, png, texture.source]); // materials share pictures
    }
    const [file] = images.find(([, , source]) => source === texture.source);
    const factor = { rgb: (material[{ map: "color", emissiveMap: "emissive" }[field]] ?? new THREE.Color(1, 1, 1)).toArray(), g: [1, material.roughness, 1], b: [1, 1, material.metalness] }[output];
    const scale = input === "normal" ? [2, 2, 2, 1] : [...factor, 1];
    shaders.push(prim("Shader", field, [], [
      'uniform token info:id = "UsdUVTexture"',
      `asset inputs:file = @${file}@`,
      `float2 inputs:st.connect = <${path}/uv.outputs:result>`,
      `token inputs:wrapS = "${WRAPS[texture.wrapS]}"`, `token inputs:wrapT = "${WRAPS[texture.wrapT]}"`,
      `token inputs:sourceColorSpace = "${colored ? "sRGB" : "raw"}"`,
      `float4 inputs:scale = ${tuple(scale)}`, input === "normal" ? "float4 inputs:bias = (-1, -1, -1, 0)" : [],
      "float3 outputs:rgb", "float outputs:g", "float outputs:b", "float outputs:a",
    ]));
    const kind = { normal: "normal3f", roughness: "float", metallic: "float" }[input] ?? "color3f";
    inputs[input] = `${kind} inputs:${input}.connect = <${path}/${field}.outputs:${output}>`;
    if (field === "map" && (material.transparent || material.alphaTest > 0))
      inputs.opacity = `float inputs:opacity.connect = <${path}/map.outputs:a>`;
  }
  if (material.alphaTest > 0) inputs.opacityThreshold = `float inputs:opacityThreshold = ${digits(material.alphaTest)}`;
  return prim("Material", name, [], [
    `token outputs:surface.connect = <${path}/surface.outputs:surface>`,
    prim("Shader", "surface", [], ['uniform token info:id = "UsdPreviewSurface"', ...Object.values(inputs), "token outputs:surface"]),
    prim("Shader", "uv", [], ['uniform token info:id = "UsdPrimvarReader_float2"', 'string inputs:varname = "st"', "float2 outputs:result"]),
    ...shaders,
  ]);
}

/** The values of an attribute, as they are meant where the file has them as whole numbers. */
function numbers(attribute, size) {
  const found = new Float32Array(size * attribute.count), get = ["getX", "getY", "getZ", "getW"];
  for (let i = 0; i < attribute.count; i++) for (let k = 0; k < size; k++) found[size * i + k] = attribute[get[k]](i);
  return found;
}

const identifier = (name, other) => (name || other).replace(/[^A-Za-z0-9_]/g, "_").replace(/^(?=\d)/, "_");
