// Whether a .glb can be moved by a face: looked at before three.js takes memory for it, and said in plain words.

import { ARKIT, sourcesOf, vowelRule } from "./arkit_names.js";
import { CharacterError, readGlb } from "./glb_container.js";

export const LARGEST_FILE = 100 * 2 ** 20; // bytes
const MOST_NUMBERS = 2 ** 27; // of all morph targets together, half a gigabyte once they are unpacked
const SHOWN = 8;
const JAW = ARKIT.indexOf("jawOpen");

/** Refuses what is too large to be read, by its size alone. */
export function checkSize(size) {
  if (size > LARGEST_FILE)
    throw new CharacterError(
      `The file has ${Math.round(size / 2 ** 20)} MB; the page takes up to ${LARGEST_FILE / 2 ** 20} MB. ` +
        "Export it with fewer vertices or smaller textures.",
    );
}

/**
 * The meshes of a .glb that have shapes, and which of these the face drives.
 *
 * @param {ArrayBuffer} bytes the whole file.
 * @param {Record<string, [number, number][] | object> | null} sources or rules of shapes by name; by ARKit's names if absent.
 * @param {Record<string, string>} changed ARKit's name, or none, of shapes whose own names say something else.
 * @returns {{document: object, binary: Uint8Array, meshes: Map<number, Shape[]>, driven: string[], unknown: string[],
 *   still: string[]}} of each mesh its shapes in the file's order, each `{name, sources, rule}`; names each once, those
 *   that would be driven but move nothing under `still`.
 */
export function checkCharacter(bytes, sources = null, changed = {}) {
  checkSize(bytes.byteLength);
  const { document, binary } = readGlb(bytes);
  const namesOf = (mesh) => mesh.extras?.targetNames ?? mesh.primitives?.[0]?.extras?.targetNames ?? [];
  const byVowels = !(document.meshes ?? []).flatMap(namesOf).some((name) => sourcesOf(String(name)).some(([row]) => row === JAW));
  const meaning = (name) => (byVowels && vowelRule(name)) || sourcesOf(name);
  const shape = (name) => {
    const given = Object.hasOwn(changed, name) ? sourcesOf(changed[name]) : sources === null ? meaning(name) : (sources[name] ?? []);
    if (Array.isArray(given)) return { name, sources: given };
    if (!given.drivers) return { name, sources: [...given.sum, ...given.product.map((row) => [row, 1])], rule: given };
    const drivers = given.drivers.map(shape); // a corrective, which follows other shapes
    return { name, sources: drivers.flatMap((one) => one.sources), drivers, knots: given.knots };
  };
  const outside = (document.images ?? []).some(({ uri }) => uri !== undefined && !uri.startsWith("data:"));
  if (outside || (document.buffers ?? []).some(({ uri }) => uri !== undefined && !uri.startsWith("data:")))
    throw new CharacterError("The character's data lie in other files. Export it as one .glb with everything inside.");
  const moves = ({ POSITION }) => {
    const { min = [1], max = [1] } = document.accessors?.[POSITION] ?? { min: [0], max: [0] };
    return [...min, ...max].some((value) => value !== 0);
  };
  const meshes = new Map(), moving = new Set();
  let numbers = 0;
  for (const [index, mesh] of (document.meshes ?? []).entries()) {
    const counts = (mesh.primitives ?? []).map((one) => one.targets?.length ?? 0);
    if (!counts[0]) continue;
    const names = namesOf(mesh);
    meshes.set(index, Array.from({ length: counts[0] }, (_, i) => shape(String(names[i] ?? `target_${i}`))));
    for (const [i, { name }] of meshes.get(index).entries())
      if (mesh.primitives.some(({ targets }) => moves(targets?.[i] ?? {}))) moving.add(name);
    for (const primitive of mesh.primitives)
      for (const target of primitive.targets ?? [])
        for (const accessor of Object.values(target)) numbers += 3 * (document.accessors?.[accessor]?.count ?? 0);
  }
  if (meshes.size === 0)
    throw new CharacterError(
      "The character has no morph targets (blendshapes), so a face cannot move it. Export it with its shape keys.",
    );
  if (!(numbers <= MOST_NUMBERS))
    throw new CharacterError("The character's shapes are too large for this page. Export it with fewer vertices.");
  const all = [...new Map([...meshes.values()].flat().map((one) => [one.name, one])).values()];
  const driven = all.filter((one) => one.sources.length > 0 && moving.has(one.name)).map((one) => one.name);
  const still = all.filter((one) => one.sources.length > 0 && !moving.has(one.name)).map((one) => one.name);
  const unknown = all.filter((one) => one.sources.length === 0).map((one) => one.name);
  return { document, binary, meshes, driven, unknown, still };
}

/** The first few names, and how many more there are. */
export function listed(names) {
  const rest = names.length - SHOWN;
  return names.slice(0, SHOWN).join(", ") + (rest > 0 ? ` and ${rest} more` : "");
}
