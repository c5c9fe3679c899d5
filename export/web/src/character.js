// A character of a .glb: its shapes by name, its head and its eyes.

import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

import { ARKIT, weightOf } from "./arkit_names.js";
import { CharacterError } from "./glb_container.js";
import { checkCharacter } from "./character_check.js";
import { upright } from "./head_angles.js";

const HEAD = /^(mixamorig:?|cc_base_)?head$/i;
const EYES = [/^(mixamorig:?|cc_base_)?(right_?eye(ball)?|eye(ball)?_?(right|r)|r_eye)$/i,
  /^(mixamorig:?|cc_base_)?(left_?eye(ball)?|eye(ball)?_?(left|l)|l_eye)$/i]; // the right one first, as the graph has them
const STILL = 1e-6; // of the character's size: what moves less does not move
const LOOKS = ARKIT.flatMap((name, row) => (name.startsWith("eyeLook") ? [row] : []));

/** Reads a character; throws a `CharacterError` in plain words for one that a face cannot move. */
export async function readCharacter(bytes, name) {
  const check = checkCharacter(bytes);
  const loader = new GLTFLoader();
  // Its own choice fetches pictures from blobs, which the page's policy forbids; an image element may show them.
  loader.register((parser) => ((parser.textureLoader = new THREE.TextureLoader(parser.options.manager)), { name: "torchface_pictures_by_elements" }));
  let gltf;
  try {
    gltf = await loader.parseAsync(bytes, "");
  } catch (error) {
    throw new CharacterError(`The character cannot be read (${error.message ?? error}). Export it once more.`);
  }
  return new Character(gltf, check, name);
}

class Character {
  #moved = [];
  #turned = [];

  constructor(gltf, check, name) {
    this.name = name;
    this.check = check;
    this.root = new THREE.Group(); // turns with the head where the character has no bone for it
    this.root.add(gltf.scene);
    this.root.updateWorldMatrix(true, true);
    gltf.scene.traverse((object) => this.#addShapes(object, check, gltf.parser.associations));
    this.box = this.#box();
    const node = (object) => gltf.parser.associations.get(object)?.nodes;
    let head = null;
    gltf.scene.traverse((object) => {
      const eye = EYES.findIndex((pattern) => pattern.test(object.name));
      if (object.isBone && head === null && HEAD.test(object.name)) head = object;
      else if (eye >= 0 && !this.#looksByShapes(object)) this.#turned.push(new Turned(object, node(object), eye));
    });
    if (head !== null) this.#turned.unshift(new Turned(head, node(head), null));
    else this.#hangUp(gltf.scene);
  }

  /** Takes what the graph says. */
  pose({ weights, rotation, gaze }) {
    for (const { influences, shapes } of this.#moved)
      for (const [row, sources] of shapes) influences[row] = weightOf(sources, weights);
    const head = turn(upright(rotation));
    if (this.#turned[0]?.eye !== null) this.root.quaternion.copy(head);
    for (const one of this.#turned) one.set(one.eye === null ? head : gazeTurn(gaze, one.eye));
  }

  /** The nodes of the file that a recording turns, each with its rotation in each frame; see `animatedGlb`. */
  turnedNodes(take) {
    return this.#turned.map((one) => ({
      node: one.node,
      quaternions: take.frames.map(({ rotation, gaze }) =>
        one.local(one.eye === null ? turn(upright(rotation)) : gazeTurn(gaze, one.eye)).toArray(),
      ),
    }));
  }

  dispose() {
    this.root.removeFromParent();
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
    const driven = shapes.flatMap(({ sources }, row) => (sources.length > 0 ? [[row, sources]] : []));
    this.#moved.push({ object, influences: object.morphTargetInfluences, shapes: driven });
  }

  /** Whether an eye is moved by looking shapes of its own, so that turning it would move it twice. */
  #looksByShapes(eye) {
    const size = this.box.getSize(new THREE.Vector3()).length();
    return this.#moved.some(
      ({ object, shapes }) =>
        (object === eye || object.parent === eye) &&
        shapes.some(([row, [[source]]]) => LOOKS.includes(source) && reach(object, row) > STILL * size),
    );
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
    return face.expandByVector(face.getSize(new THREE.Vector3()).multiply(new THREE.Vector3(0.35, 0.45, 0.35))).intersect(whole);
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
  #above;
  #rest;

  constructor(object, node, eye) {
    this.object = object;
    this.node = node;
    this.eye = eye;
    this.#above = object.parent.getWorldQuaternion(new THREE.Quaternion());
    this.#rest = object.quaternion.clone();
  }

  local(turned) {
    return this.#above.clone().invert().multiply(turned).multiply(this.#above).multiply(this.#rest);
  }

  set(turned) {
    this.object.quaternion.copy(this.local(turned));
  }
}

function turn(rows) {
  if (!rows.every(Number.isFinite)) return new THREE.Quaternion();
  const [a, b, c, d, e, f, g, h, i] = rows;
  return new THREE.Quaternion().setFromRotationMatrix(new THREE.Matrix4().set(a, b, c, 0, d, e, f, 0, g, h, i, 0, 0, 0, 0, 1));
}

/** Of the gaze's angles to the person's left, which is x, and up. */
function gazeTurn(gaze, eye) {
  const [aside, up] = [gaze[2 * eye], gaze[2 * eye + 1]];
  if (!Number.isFinite(aside + up)) return new THREE.Quaternion();
  return new THREE.Quaternion().setFromEuler(new THREE.Euler(-up, aside, 0, "YXZ"));
}

function reach(mesh, row) {
  const deltas = mesh.geometry.morphAttributes.position?.[row];
  let most = 0;
  for (let i = 0; i < (deltas?.count ?? 0); i++)
    most = Math.max(most, Math.hypot(deltas.getX(i), deltas.getY(i), deltas.getZ(i)));
  return most;
}
