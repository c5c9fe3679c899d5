// A recording as an animation inside the character's own .glb: a channel of weights for each mesh that has shapes.

import { weightOf } from "./arkit_names.js";
import { writeGlb } from "./glb_container.js";

const FLOAT = 5126;

/**
 * The character's file with the recording as its first animation, which readers of one take; all else in it stays as it was.
 *
 * @param {object} character what `checkCharacter` returned.
 * @param {Take} take the recording, at least one frame.
 * @param {{node: number | null, pivot?: number[], quaternions: number[][]}[]} turned nodes that were rotated, and how in each frame (x, y, z, w);
 *   without a node the whole scene about `pivot`.
 * @returns {Uint8Array} a .glb.
 */
export function animatedGlb(character, take, turned = []) {
  const document = structuredClone(character.document);
  const writer = new KeyWriter(document, character.binary);
  const input = writer.add(take.seconds, "SCALAR", true);
  const samplers = [], channels = [];
  const drive = (node, path, output) => {
    channels.push({ sampler: samplers.length, target: { node, path } });
    samplers.push({ input, output, interpolation: "LINEAR" });
  };
  const outputs = new Map();
  for (const [index, node] of (document.nodes ?? []).entries()) {
    const shapes = character.meshes.get(node.mesh);
    if (shapes === undefined) continue;
    const rest = node.weights ?? document.meshes[node.mesh].weights ?? [];
    const key = JSON.stringify([shapes.map(({ name }) => name), rest]); // primitives of one head share their keys
    if (!outputs.has(key)) outputs.set(key, writer.add(keys(shapes, rest, take), "SCALAR"));
    drive(index, "weights", outputs.get(key));
  }
  for (const { node, pivot, quaternions } of turned)
    drive(node ?? hungUp(document, pivot), "rotation", writer.add(quaternions.flat(), "VEC4"));
  document.animations = [{ name: "performance", samplers, channels }, ...(document.animations ?? [])];
  return writeGlb(document, writer.binary());
}

/** The node that turns all that the first scene shows about a point. */
function hungUp(document, pivot) {
  const scene = document.scenes[document.scene ?? 0], at = document.nodes.length;
  document.nodes.push({ name: "head", translation: pivot, children: [at + 1] }, { translation: pivot.map((value) => -value), children: scene.nodes });
  scene.nodes = [at];
  return at;
}

function keys(shapes, rest, take) {
  return take.frames.flatMap(({ weights }) =>
    shapes.map((shape, i) => (shape.sources.length > 0 ? weightOf(shape, weights) : (rest[i] ?? 0))),
  );
}

/** Appends numbers to the buffer, with the views and accessors that tell where they are. */
export class KeyWriter {
  #document;
  #chunks;
  #size;

  constructor(document, binary) {
    this.#document = document;
    this.#chunks = [[0, binary]];
    this.#size = binary.length;
    document.accessors ??= [];
    document.bufferViews ??= [];
  }

  add(numbers, type, bounds = false) {
    const values = Float32Array.from(numbers);
    const { accessors, bufferViews } = this.#document;
    const byteOffset = Math.ceil(this.#size / 4) * 4;
    this.#chunks.push([byteOffset, new Uint8Array(values.buffer)]);
    this.#size = byteOffset + values.byteLength;
    const count = values.length / { SCALAR: 1, VEC3: 3, VEC4: 4 }[type];
    const limits = bounds ? { min: [values[0]], max: [values.at(-1)] } : {};
    accessors.push({ bufferView: bufferViews.length, componentType: FLOAT, count, type, ...limits });
    bufferViews.push({ buffer: 0, byteOffset, byteLength: values.byteLength });
    return accessors.length - 1;
  }

  binary() {
    const whole = new Uint8Array(this.#size);
    for (const [at, chunk] of this.#chunks) whole.set(chunk, at);
    return whole;
  }
}
