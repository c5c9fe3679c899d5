// A character of a .glb: its shapes by name, its head and its eyes.

import * as THREE from "three";

import { ARKIT, weightOf } from "./arkit_names.js";
import { characterBones, looksBack } from "./character_bones.js";
import { checkCharacter } from "./character_check.js";
import { characterLoader } from "./character_loader.js";
import { CharacterError } from "./glb_container.js";
import { upright } from "./head_angles.js";
import { wrinkleMaps } from "./wrinkle_maps.js";

export const NECKS = 0.3; // of the head's rotation, where there is a neck
const BOUND = 0.5, LEAST = 0.05; // of an eye's vertices to its bone; of a shape's largest motion, that an eye looks by it
const RAISED = -0.5; // of an arm's way downwards; arms that hang lower stay
const HANGING = [0.22, -0.97, 0.08]; // an arm at rest: outwards, up, forwards
const LOOKS = ARKIT.flatMap((name, row) => (name.startsWith("eyeLook") ? [row] : []));

/**
 * Reads a character; throws a `CharacterError` in plain words for one that cannot be used.
 *
 * @param {ArrayBuffer} bytes of a .glb or .vrm.
 * @param {string} name of the file.
 * @param {object | null} sources of each shape by its name, where ARKit's names do not say them; see `sourcesOf`.
 * @param {Record<string, string>} changed what the user says that names mean; see `changedNames`.
 */
export async function readCharacter(bytes, name, sources = null, changed = {}) {
  const check = checkCharacter(bytes, sources, changed);
  let gltf;
  const nodes = new Map();
  let wrinkles;
  try {
    gltf = await (await characterLoader(check.document)).parseAsync(bytes, "");
    for (const [part, node] of Object.entries(characterBones(check.document)))
      nodes.set(part, { node, object: await gltf.parser.getDependency("node", node) });
    wrinkles = await wrinkleMaps(gltf, check.document);
  } catch (error) {
    throw new CharacterError(`The character cannot be read (${error.message ?? error}). Export it once more.`);
  }
  return new Character(gltf, check, nodes, wrinkles, { bytes, name, sources, changed });
}

export class Character {
  #moved = [];
  #turned = [];
  #given;

  constructor(gltf, check, nodes, wrinkles, given) {
    [this.name, this.check, this.wrinkles, this.#given] = [given.name, check, wrinkles, given];
    this.root = new THREE.Group(); // turns with the head where the character has no bone for it
    this.root.add(gltf.scene);
    if (looksBack(check.document)) gltf.scene.rotation.y = Math.PI;
    this.root.updateMatrixWorld(true); // of skins too
    for (const side of ["left", "right"]) hang(nodes.get(`${side}UpperArm`)?.object, nodes.get(`${side}LowerArm`)?.object);
    gltf.scene.traverse((object) => this.#addShapes(object, check, gltf.parser.associations));
    this.box = this.#box();
    const head = nodes.get("head"), neck = head && nodes.get("neck");
    if (neck) this.#turned.push(new Turned(neck, ({ rotation }) => turn(rotation, NECKS)));
    if (head) this.#turned.push(new Turned(head, ({ rotation }) => turn(rotation, neck ? 1 - NECKS : 1)));
    else this.#hangUp(gltf.scene);
    ["rightEye", "leftEye"].forEach((part, eye) => {
      const found = nodes.get(part);
      if (found && !this.#looksByShapes(found.object)) this.#turned.push(new Turned(found, ({ gaze }) => gazeTurn(gaze, eye)));
    });
    this.hasHead = head !== undefined;
  }

  /** Takes what the graph says. */
  pose(solved) {
    for (const { influences, shapes } of this.#moved)
      for (const [row, shape] of shapes) influences[row] = weightOf(shape, solved.weights);
    if (!this.hasHead) this.root.quaternion.copy(turn(solved.rotation));
    for (const one of this.#turned) one.pose(solved);
  }

  /** The nodes of the file that a recording turns, each with its rotation in each frame; see `animatedGlb`. */
  turnedNodes(take) {
    const found = this.#turned.map((one) => ({ node: one.node, object: one.object, quaternions: take.frames.map((frame) => one.local(frame).toArray()) }));
    if (this.hasHead) return found;
    const quaternions = take.frames.map(({ rotation }) => turn(rotation).toArray());
    return [...found, { node: null, object: this.root, pivot: this.root.position.toArray(), quaternions }];
  }

  /** Rows of a mesh's morph targets that are driven, each with its shape. */
  shapesOf(mesh) {
    return this.#moved.find(({ object }) => object === mesh)?.shapes ?? [];
  }

  /** The character once more, at rest, which nothing else poses. */
  again(changed = this.#given.changed) {
    return readCharacter(this.#given.bytes, this.name, this.#given.sources, changed);
  }

  dispose() {
    this.root.removeFromParent();
    for (const one of this.wrinkles) one.dispose();
    this.root.traverse((object) => {
      object.geometry?.dispose();
      for (const material of [object.material ?? []].flat()) {
        for (const value of Object.values(material)) if (value?.isTexture) value.dispose();
        material.dispose();
      }
    });
  }

  #addShapes(object, check, associations) {
    if (!object.isMesh) return;
    object.frustumCulled = false; // shapes and bones reach beyond the box that it is culled by
    const shapes = check.meshes.get(associations.get(object)?.meshes);
    if (!object.morphTargetInfluences || shapes === undefined) return;
    const driven = shapes.flatMap((shape, row) => (shape.sources.length > 0 ? [[row, shape]] : []));
    this.#moved.push({ object, influences: object.morphTargetInfluences, shapes: driven });
  }

  /** Whether an eye is moved by looking shapes, of its own mesh or of one whose skin binds it, so that turning it would move it twice. */
  #looksByShapes(eye) {
    return this.#moved.some(({ object, shapes }) => {
      const own = object === eye || object.parent === eye, bone = own ? null : (object.skeleton?.bones.indexOf(eye) ?? -1);
      if (bone === -1) return false;
      return shapes.some(([row, { sources: [[source]] }]) => LOOKS.includes(source) && reach(object, row, bone) > LEAST * reach(object, row));
    });
  }

  /** Of what the shapes move, for a whole body its face; with some room, and no larger than the character. */
  #box() {
    const whole = new THREE.Box3().setFromObject(this.root, true);
    const face = new THREE.Box3(), point = new THREE.Vector3(), least = 1e-3 * whole.getSize(point).length();
    for (const { object, shapes } of this.#moved) {
      const count = object.geometry.attributes.position.count, moves = new Uint8Array(count);
      for (const [row] of shapes) {
        const deltas = object.geometry.morphAttributes.position?.[row];
        if (!deltas) continue;
        for (let i = 0; i < count; i++)
          moves[i] |= Math.hypot(deltas.getX(i), deltas.getY(i), deltas.getZ(i)) > least;
      }
      for (let i = 0; i < count; i++)
        if (moves[i]) face.expandByPoint(object.getVertexPosition(i, point).applyMatrix4(object.matrixWorld));
    }
    if (face.isEmpty()) return whole;
    const { x, y, z } = face.getSize(point); // more room above, where the forehead and the hair are
    face.min.sub(new THREE.Vector3(0.35 * x, 0.15 * y, 0.35 * z));
    face.max.add(new THREE.Vector3(0.35 * x, 0.45 * y, 0.35 * z));
    return face.intersect(whole);
  }

  /** Without a bone the whole character turns about its neck. */
  #hangUp(scene) {
    const size = this.box.getSize(new THREE.Vector3()), neck = this.box.getCenter(new THREE.Vector3());
    neck.y -= 0.25 * size.y;
    neck.z -= 0.1 * size.z;
    this.root.position.copy(neck);
    scene.position.sub(neck);
  }
}

/** A node that is turned about its own origin, in the world's directions, from where it rests. */
class Turned {
  #way;
  #above;
  #rest;

  constructor({ object, node }, way) {
    [this.object, this.node, this.#way] = [object, node, way];
    this.#above = object.parent.getWorldQuaternion(new THREE.Quaternion());
    this.#rest = object.quaternion.clone();
  }

  local(frame) {
    return this.#above.clone().invert().multiply(this.#way(frame)).multiply(this.#above).multiply(this.#rest);
  }

  pose(frame) {
    this.object.quaternion.copy(this.local(frame));
  }
}

/** A share of the head's rotation, in the world's directions. */
export function turn(rotation, share = 1) {
  const rows = upright(rotation), turned = new THREE.Quaternion();
  if (!rows.every(Number.isFinite)) return turned;
  const [a, b, c, d, e, f, g, h, i] = rows;
  const whole = turned.clone().setFromRotationMatrix(new THREE.Matrix4().set(a, b, c, 0, d, e, f, 0, g, h, i, 0, 0, 0, 0, 1));
  return turned.slerp(whole, share);
}

/** Lets an arm hang that stands off, as in the pose in which skeletons are bound. */
function hang(upper, lower) {
  if (!upper || !lower) return;
  const from = upper.getWorldPosition(new THREE.Vector3());
  const way = lower.getWorldPosition(new THREE.Vector3()).sub(from).normalize();
  if (!(way.y > RAISED)) return;
  const [out, up, front] = HANGING;
  const turned = new THREE.Quaternion().setFromUnitVectors(way, new THREE.Vector3(out * Math.sign(way.x), up, front).normalize());
  const above = upper.parent.getWorldQuaternion(new THREE.Quaternion());
  upper.quaternion.premultiply(above.clone().invert().multiply(turned).multiply(above));
  upper.updateWorldMatrix(false, true);
}

/** Of the gaze's angles to the person's left, which is x, and up. */
export function gazeTurn(gaze, eye) {
  const [aside, up] = [gaze[2 * eye], gaze[2 * eye + 1]];
  if (!Number.isFinite(aside + up)) return new THREE.Quaternion();
  return new THREE.Quaternion().setFromEuler(new THREE.Euler(-up, aside, 0, "YXZ"));
}

/** How far a shape moves vertices, those alone that are bound to a bone, or all. */
function reach(mesh, row, bone = null) {
  const { skinIndex, skinWeight } = mesh.geometry.attributes, deltas = mesh.geometry.morphAttributes.position?.[row];
  const bound = (i) => bone === null || [0, 1, 2, 3].some((k) => skinIndex.getComponent(i, k) === bone && skinWeight.getComponent(i, k) > BOUND);
  let most = 0;
  for (let i = 0; i < (deltas?.count ?? 0); i++)
    if (bound(i)) most = Math.max(most, Math.hypot(deltas.getX(i), deltas.getY(i), deltas.getZ(i)));
  return most;
}
