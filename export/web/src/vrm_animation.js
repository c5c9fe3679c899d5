// A take as a VRM animation (.vrma): neck and head, the gaze, and VRM's expressions, or ARKit's for a character with a jaw among these.

import { ARKIT } from "./arkit_names.js";
import { gazeTurn, NECKS, turn } from "./character.js";
import { KeyWriter } from "./glb_animation.js";
import { writeGlb } from "./glb_container.js";
import { VRM_BOTH, VRM_POSES } from "./shape_tables.js";

const BONES = [["hips", 1], ["spine", 0.1], ["chest", 0.2], ["neck", 0.2], ["head", 0.1]]; // each above the one before, metres
const RIDGE = 1e-5, ROUNDS = 200;
const SIDES = ["", "Left", "Right"];
const SOLVED = Object.keys(VRM_POSES).filter((name) => !(name in VRM_BOTH));
const POSES = SOLVED.map((name) => ARKIT.map((arkit) => Math.max(0, ...Object.entries(VRM_POSES[name]).map(([part, weight]) => (SIDES.some((side) => part + side === arkit) ? weight : 0)))));
const PRODUCTS = POSES.map((a, i) => POSES.map((b, k) => dot(a, b) + (i === k ? RIDGE : 0)));

function dot(a, b) {
  return a.reduce((sum, value, i) => sum + value * b[i], 0);
}

/** VRM 1's expressions, 0 to 1, that together are nearest to ARKit's weights, by name. */
export function vrmExpressions(weights) {
  const wanted = POSES.map((pose) => dot(pose, weights)), found = new Array(SOLVED.length).fill(0);
  for (let round = 0; round < ROUNDS; round++)
    for (let i = 0; i < found.length; i++) // one after another, the others held
      found[i] = Math.min(1, Math.max(0, found[i] + (wanted[i] - dot(PRODUCTS[i], found)) / PRODUCTS[i][i]));
  const named = Object.fromEntries(SOLVED.map((name, i) => [name, found[i]]));
  for (const [whole, [left, right]] of Object.entries(VRM_BOTH)) {
    named[whole] = Math.min(named[left], named[right]);
    named[left] -= named[whole];
    named[right] -= named[whole];
  }
  return named;
}

/** ARKit's shapes that a VRM has as expressions of its own, by what it calls them. */
function ownExpressions({ extensions = {} }) {
  const names = [...Object.keys(extensions.VRMC_vrm?.expressions?.custom ?? {}), ...(extensions.VRM?.blendShapeMaster?.blendShapeGroups ?? []).map(({ name }) => name)];
  const rows = new Map(ARKIT.map((arkit, row) => [arkit.toLowerCase(), row]));
  return names.filter((name) => rows.has(String(name).toLowerCase())).map((name) => [name, rows.get(name.toLowerCase())]);
}

/**
 * @param {Take} take at least one frame.
 * @param {object} character what `checkCharacter` returned of the one that is shown.
 * @returns {Uint8Array} a .vrma.
 */
export function vrmAnimation(take, character) {
  const document = { asset: { version: "2.0", generator: "torchface" }, scene: 0, scenes: [{ nodes: [0] }], nodes: [] };
  const writer = new KeyWriter(document, new Uint8Array(0)), input = writer.add(take.seconds, "SCALAR", true);
  const samplers = [], channels = [];
  const node = (name, fields = {}) => document.nodes.push({ name, ...fields }) - 1;
  const drive = (target, path, values, type) => {
    channels.push({ sampler: samplers.length, target: { node: target, path } });
    samplers.push({ input, output: writer.add(values, type), interpolation: "LINEAR" });
  };
  const humanBones = {};
  for (const [i, [bone, height]] of BONES.entries()) {
    const made = node(bone, { translation: [0, height, 0], ...(i + 1 < BONES.length ? { children: [i + 1] } : {}) });
    humanBones[bone] = { node: made };
  }
  const turns = (share) => take.frames.flatMap(({ rotation }) => turn(rotation, share).toArray());
  drive(humanBones.neck.node, "rotation", turns(NECKS), "VEC4");
  drive(humanBones.head.node, "rotation", turns(1 - NECKS), "VEC4");
  const lookAt = node("lookAt");
  document.scenes[0].nodes.push(lookAt);
  const mean = (gaze) => [(gaze[0] + gaze[2]) / 2, (gaze[1] + gaze[3]) / 2];
  drive(lookAt, "rotation", take.frames.flatMap(({ gaze }) => gazeTurn(mean(gaze), 0).toArray()), "VEC4");
  const expression = (name, values) => {
    const made = node(name);
    document.scenes[0].nodes.push(made);
    drive(made, "translation", values.flatMap((value) => [value, 0, 0]), "VEC3");
    return { node: made };
  };
  const all = ownExpressions(character.document), synced = all.some(([, row]) => ARKIT[row] === "jawOpen"); // "perfect sync"
  const own = synced ? all : all.filter(([, row]) => POSES.every((pose) => pose[row] === 0)); // others would move twice
  const presets = synced ? [] : take.frames.map(({ weights }) => vrmExpressions(weights));
  const preset = synced ? {} : Object.fromEntries(Object.keys(VRM_POSES).map((name) => [name, expression(name, presets.map((all) => all[name]))]));
  const custom = Object.fromEntries(own.map(([name, row]) => [name, expression(name, take.frames.map(({ weights }) => weights[row]))]));
  document.animations = [{ name: "performance", samplers, channels }];
  document.extensionsUsed = ["VRMC_vrm_animation"];
  document.extensions = {
    VRMC_vrm_animation: { specVersion: "1.0", humanoid: { humanBones }, expressions: { preset, custom }, lookAt: { node: lookAt, offsetFromHeadBone: [0, 0.06, 0] } },
  };
  return writeGlb(document, writer.binary());
}
