// Which character: the one that came with the page, one that is chosen, or one that is dropped on it.

import { ARKIT } from "./arkit_names.js";
import { readCharacter } from "./character.js";
import { checkSize, listed } from "./character_check.js";
import { forgetFile, keepFile, keptFile } from "./kept_files.js";
import { changedNames } from "./shape_name_table.js";
import { hideProblem, showCharacterLine, showProblem } from "./words.js";

const KEY = "character", TONGUE = ARKIT.indexOf("tongueOut");
const element = (id) => document.getElementById(id);

/**
 * Lets the user choose; a file that cannot be used leaves the character before where it is.
 *
 * @param {(character: object) => void} use is given each one that can be used.
 * @param {(file: File) => void} useTake is given each recording that is dropped.
 */
export function offerCharacters(use, useTake) {
  const take = (file) => (/\.csv$/i.test(file.name) ? useTake(file) : taken(file, use, null, true));
  element("choose").addEventListener("click", () => element("file").click());
  element("file").addEventListener("change", ({ target }) => {
    if (target.files.length > 0) take(target.files[0]);
    target.value = ""; // the same file may be chosen again
  });
  element("own").addEventListener("click", async () => {
    await forgetFile(KEY).catch(() => {});
    await shippedCharacter(use, false);
  });
  const dropping = (event, on) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", on);
  };
  document.addEventListener("dragover", (event) => dropping(event, true));
  document.addEventListener("dragleave", (event) => event.relatedTarget === null && dropping(event, false));
  document.addEventListener("drop", (event) => {
    dropping(event, false);
    for (const file of event.dataTransfer.files) take(file);
  });
}

/**
 * The character that was chosen last, else the one beside the page.
 *
 * @param {(character: object) => void} use is given it.
 * @param {boolean} remembered whether one that was chosen before comes first.
 * @param {(bytes: number, all: boolean) => void} tell is told how much is here, and at last that it is all.
 */
export async function shippedCharacter(use, remembered = true, tell = () => {}) {
  const kept = remembered ? await keptFile(KEY).catch(() => null) : null;
  if (kept) tell(kept.size, true);
  if (kept && (await taken(kept, use, null, false))) return;
  const [answer, shapes] = await Promise.all([fetch("./character.glb"), fetch("./character.json")]);
  if (!answer.ok) return showProblem("character", "character.glb is not beside this page; choose one of your own.");
  const { name, sources } = shapes.ok ? await shapes.json() : { name: "character.glb", sources: null };
  let bytes = 0;
  const counted = new TransformStream({ transform: (part, to) => (tell((bytes += part.length), false), to.enqueue(part)) });
  const content = await new Response(answer.body.pipeThrough(counted)).blob();
  tell(bytes, true);
  await taken(new File([content], name), use, sources, false);
}

async function taken(file, use, sources, keep) {
  try {
    checkSize(file.size);
    const character = await readCharacter(await file.arrayBuffer(), file.name, sources, changedNames(file.name));
    element("own").hidden = sources !== null;
    use(character);
    if (keep) await keepFile(KEY, file).catch(() => {}); // a browser that keeps nothing
    hideProblem("character");
    return true;
  } catch (error) {
    showProblem("character", `${file.name}: ${error.message}`);
    return false;
  }
}

/** Says which of a character's shapes the face moves; no camera sees the tongue, and phones send it. */
export function tellCharacter({ name, check: { driven, unknown, still, meshes } }) {
  const shapes = new Map([...meshes.values()].flat().map((one) => [one.name, one]));
  const tongues = driven.filter((one) => shapes.get(one).sources.every(([row]) => row === TONGUE));
  const words = [`your face moves ${driven.length - tongues.length} of its ${driven.length + unknown.length + still.length} shapes`];
  if (tongues.length > 0) words.push(`${tongues.join(", ")} moves only when a phone sends the face: a camera does not see the tongue`);
  if (still.length > 0) words.push(`its ${still.join(", ")} ${still.length > 1 ? "move" : "moves"} nothing`);
  if (unknown.length > 0) words.push(`these stay still: ${listed(unknown)}`);
  const hint = driven.length === 0 ? ". Say below, at Names of shapes, which of ARKit's each of them means" : "";
  showCharacterLine(`${name}: ${words.join("; ")}${hint}`);
}
