// Runs the page's modules under Node: node modules.mjs FOLDER, where FOLDER has src/. Each line of input is a job as
// JSON, [name, file]; its answer is a line of JSON, of what failed {"error": text}.
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const folder = process.argv[2];
const load = (name) => import(pathToFileURL(`${folder}/src/${name}.js`).href);
let input, bytes;

const jobs = {
  /** What each of a list of names takes of ARKit's weights. */
  async names() {
    const { ARKIT, sourcesOf } = await load("arkit_names");
    return { arkit: ARKIT, sources: JSON.parse(input).map(sourcesOf) };
  },

  /** What a calibration asks and says of frames of [milliseconds, whether a face is seen, weights by name]. */
  async calibration() {
    const { Calibration } = await load("calibration");
    const { ARKIT } = await load("arkit_names");
    const calibration = new Calibration(), told = [];
    for (const [time, seen, shown] of JSON.parse(input)) {
      const number = calibration.number;
      const step = calibration.advance(time, seen, ARKIT.map((name) => shown[name] ?? 0));
      told.push({ number, step, pose: step === "done" ? 0 : calibration.pose, remark: calibration.remark });
      if (step === "done") break;
    }
    return { told, missed: calibration.missed, result: calibration.result, gains: calibration.gains };
  },

  /** What is said of frames of [{presence, beside, calibrated}, whether the picture is shown in a mirror]. */
  async words() {
    const { StateWords } = await load("state_words");
    const words = new StateWords();
    return JSON.parse(input).map(([solved, mirrored]) => words.of(solved, mirrored));
  },

  /** Frames of {weights, rotation, gaze, interval} as settings want them. */
  async controls() {
    const { WeightControls } = await load("weight_controls");
    const controls = new WeightControls();
    return JSON.parse(input).map(({ solved, settings }) => {
      const { weights, rotation, gaze } = controls.apply(solved, settings);
      return [...weights, ...rotation, ...gaze];
    });
  },

  /** What is kept of two people who take turns, after a reload too. */
  async people() {
    const kept = new Map();
    globalThis.localStorage = { getItem: (key) => kept.get(key) ?? null, setItem: (key, value) => kept.set(key, value) };
    const { choosePerson, keepSettings, settings } = await load("settings");
    const now = () => ({ person: settings.person, gain: settings.gain, gains: settings.gains, groups: settings.groups });
    choosePerson("Anna");
    keepSettings({ gains: { jawOpen: 2 }, gain: 1.5 });
    choosePerson("__proto__");
    const other = now();
    keepSettings({ groups: { jaw: { gain: 0.5 } } });
    choosePerson("Anna");
    const again = now();
    const reloaded = (await import(`${pathToFileURL(`${folder}/src/settings.js`).href}?again`)).settings;
    return { other, again, reloaded, people: Object.keys(reloaded.people) };
  },

  /** Settings of each shape, of groups and factors by shape. */
  async settings() {
    const { shapeSettings } = await load("weight_controls");
    const { groups, gains } = JSON.parse(input);
    return shapeSettings(groups, gains);
  },

  /** A take of one frame or more, given as rows, as a file of a kind, base64. */
  async save() {
    globalThis.self = globalThis;
    const { readCharacter } = await load("character");
    const { KINDS } = await load("take_files");
    const { Take } = await load("take");
    const { glb, rows, kind, sources = null, changed } = JSON.parse(input);
    const data = readFileSync(glb);
    const character = await readCharacter(data.buffer.slice(data.byteOffset, data.byteOffset + data.length), "file", sources, changed);
    const made = await KINDS[kind](Take.ofRows(Float32Array.from(rows.flat())), character);
    return Buffer.from(await new Blob([made]).arrayBuffer()).toString("base64");
  },

  /** Where each mesh's vertices are in each frame of a take, as three.js has them. */
  async places() {
    globalThis.self = globalThis;
    const { readCharacter } = await load("character");
    const { Take } = await load("take");
    const { Vector3 } = await import("three");
    const { glb, rows } = JSON.parse(input), data = readFileSync(glb), meshes = [];
    const character = await readCharacter(data.buffer.slice(data.byteOffset, data.byteOffset + data.length), "file");
    character.root.traverse((object) => object.isMesh && meshes.push(object));
    return Take.ofRows(Float32Array.from(rows.flat())).frames.map((frame) => {
      character.pose(frame);
      character.root.updateMatrixWorld(true);
      return meshes.map((mesh) => Array.from({ length: mesh.geometry.attributes.position.count }, (_, i) => mesh.getVertexPosition(i, new Vector3()).applyMatrix4(mesh.matrixWorld).toArray()));
    });
  },

  /** Rows of the take of a .csv, or what is said of one that is none. */
  async csv() {
    const { readLiveLinkCsv } = await load("live_link_csv");
    try {
      return Array.from(readLiveLinkCsv(input.toString()).rows);
    } catch (error) {
      return error.message;
    }
  },

  /** Tables of names, and what ARKit calls a list of names. */
  async tables() {
    const { arkitName, vowelRule } = await load("arkit_names"), names = JSON.parse(input);
    return { ...(await load("shape_tables")), names: names.map((name) => arkitName(name) ?? null), rules: names.map((name) => vowelRule(name)?.sum ?? []) };
  },

  /** VRM's expressions of weights. */
  async expressions() {
    const { vrmExpressions } = await load("vrm_animation");
    return JSON.parse(input).map(vrmExpressions);
  },

  /** The time of a part of a take that begins at 10 s. */
  async part() {
    const { Take } = await load("take");
    const take = new Take(), nothing = new Float32Array(9);
    for (let i = 0; i < 30; i++) take.add(10_000 + 100 * i, { weights: nothing, rotation: nothing, gaze: nothing });
    return take.part(...JSON.parse(input)).seconds;
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

  /** Materials of a skin, of one whose wrinkles come and go, of an eye, and of a skin that counts as metal, made lighter: type, whether normals are drawn, and how the picture's colours are read. The eye's picture glows too. */
  async lighter() {
    const { lighten, withoutMetal } = await load("lighter_drawing");
    const THREE = await import("three");
    const still = new THREE.Texture(), mixed = new THREE.WebGLRenderTarget(2, 2).texture, root = new THREE.Group();
    for (const [normalMap, roughness, metalness] of [[still, 1, 0], [mixed, 1, 0], [still, 0.25, 0], [still, 1, 1]]) {
      const map = Object.assign(new THREE.Texture(), { colorSpace: THREE.SRGBColorSpace }), emissiveMap = roughness < 1 ? map : null;
      root.add(new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshStandardMaterial({ normalMap, roughness, metalness, map, emissiveMap })));
    }
    withoutMetal(root);
    lighten(root);
    return root.children.map(({ material }) => [material.type, material.normalMap !== null, material.map.colorSpace]);
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
    const influences = {}, ways = {}, places = {};
    character.root.traverse((object) => {
      for (const [name, row] of Object.entries(object.morphTargetDictionary ?? {})) influences[name] = object.morphTargetInfluences[row];
      places[object.name] = object.getWorldPosition(new Vector3()).toArray();
      ways[object.name || "root"] = new Vector3(0, 0, 1).transformDirection(object.matrixWorld).toArray();
    });
    return { influences, ways, places, box: [character.box.min.toArray(), character.box.max.toArray()] };
  },
};
for await (const line of createInterface({ input: process.stdin })) {
  const [job, file] = JSON.parse(line);
  input = readFileSync(file);
  bytes = input.buffer.slice(input.byteOffset, input.byteOffset + input.length);
  const answer = await jobs[job]().then((found) => ({ found }), (error) => ({ error: `${error.stack}` }));
  console.log(JSON.stringify(answer));
}
