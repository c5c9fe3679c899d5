// Runs the page's modules under Node: node modules.mjs FOLDER JOB FILE, where FOLDER has src/; prints the answer as JSON.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, job, file] = process.argv.slice(2);
const load = (name) => import(pathToFileURL(`${folder}/src/${name}.js`).href);
const input = readFileSync(file);
const bytes = input.buffer.slice(input.byteOffset, input.byteOffset + input.length);

const jobs = {
  /** What each of a list of names takes of ARKit's weights. */
  async names() {
    const { ARKIT, sourcesOf } = await load("arkit_names");
    return { arkit: ARKIT, sources: JSON.parse(input).map(sourcesOf) };
  },

  /** The poses that frames of a list of [milliseconds, whether a face is seen] are told, and when it was over. */
  async calibration() {
    const { Calibration } = await load("calibration");
    const calibration = new Calibration(), poses = [], prompts = new Set();
    for (const [time, seen] of JSON.parse(input)) {
      prompts.add(calibration.prompt);
      poses.push(calibration.pose);
      if (calibration.advance(time, seen) === "done") return { poses, done: time, prompts: [...prompts] };
    }
    return { poses, done: null };
  },

  /** Times and rate of a recording of frames at these milliseconds. */
  async take() {
    const { Take } = await load("take");
    const take = new Take(), nothing = new Float32Array(9);
    for (const time of JSON.parse(input)) take.add(time, { weights: nothing, rotation: nothing, gaze: nothing });
    return { seconds: take.seconds, rate: take.rate };
  },

  /** Vertices of a character in one pose as three.js has them of its targets, and as they are summed for software WebGL. */
  async morphing() {
    globalThis.self = globalThis;
    const { readCharacter } = await load("character");
    const { ProcessorMorphing } = await load("processor_morphing");
    const { Vector3 } = await import("three");
    const character = await readCharacter(bytes, "file"), meshes = [];
    character.root.traverse((object) => object.isMesh && object.morphTargetInfluences && meshes.push(object));
    const pose = (shift) => meshes.forEach(({ morphTargetInfluences: all }, mesh) => all.forEach((_, row) => (all[row] = ((row + mesh + shift) % 3) / 3)));
    const vertices = (of) => meshes.map((mesh) => Array.from({ length: mesh.geometry.attributes.position.count }, (_, i) => of(mesh, i).toArray()));
    pose(0);
    const expected = vertices((mesh, i) => mesh.getVertexPosition(i, new Vector3()));
    const morphing = new ProcessorMorphing(character.root);
    pose(1); // what was before leaves nothing
    morphing.update();
    pose(0);
    morphing.update();
    const found = vertices((mesh, i) => new Vector3().fromBufferAttribute(mesh.geometry.attributes.position, i));
    return { expected, found, left: meshes.some((mesh) => "position" in mesh.geometry.morphAttributes) };
  },

  /** Drawings of [milliseconds, and those for each pixel drawn for one of the page's], from two on: their time, rest and ratio. */
  async pace() {
    const { DrawingPace } = await load("drawing_pace");
    const pace = new DrawingPace(2);
    return JSON.parse(input).map(([fixed, each]) => {
      const took = fixed + each * pace.ratio ** 2;
      return [took, pace.rest(took), pace.ratio];
    });
  },

  /** What is said of a character that cannot be used. */
  async refusal() {
    const { checkCharacter } = await load("character_check");
    try {
      checkCharacter(bytes);
      return null;
    } catch (error) {
      return error.message;
    }
  },

  /** A character in one pose: influences by name, and where a point before its face and its eyes look. */
  async pose() {
    globalThis.self = globalThis;
    const { readCharacter } = await load("character");
    const { ARKIT } = await load("arkit_names");
    const { Vector3 } = await import("three");
    const character = await readCharacter(bytes, "file");
    const weights = Float32Array.from(ARKIT, (_, i) => (i + 1) / 100);
    const [c, s] = [Math.cos(0.3), Math.sin(0.3)]; // a yaw of 0.3 before an OpenCV camera
    character.pose({ weights, rotation: Float32Array.of(c, 0, s, 0, -1, 0, s, 0, -c), gaze: Float32Array.of(0.2, 0.1, 0.2, 0.1) });
    character.root.updateWorldMatrix(true, true);
    const influences = {}, ways = {};
    character.root.traverse((object) => {
      for (const [name, row] of Object.entries(object.morphTargetDictionary ?? {})) influences[name] = object.morphTargetInfluences[row];
      ways[object.name || "root"] = new Vector3(0, 0, 1).transformDirection(object.matrixWorld).toArray();
    });
    return { influences, ways, box: [character.box.min.toArray(), character.box.max.toArray()] };
  },
};
console.log(JSON.stringify(await jobs[job]()));
