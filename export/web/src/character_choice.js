// Which character: the one that came with the page, one that is chosen, or one that is dropped on it.

import { readCharacter } from "./character.js";
import { checkSize, listed } from "./character_check.js";
import { hideProblem, showCharacterLine, showProblem } from "./words.js";

const element = (id) => document.getElementById(id);

/**
 * Lets the user choose; a file that cannot be used leaves the character before where it is.
 *
 * @param {(character: object) => void} use is given each one that can be used.
 */
export function offerCharacters(use) {
  element("choose").addEventListener("click", () => element("file").click());
  element("file").addEventListener("change", ({ target }) => {
    if (target.files.length > 0) take(target.files[0], use);
    target.value = ""; // the same file may be chosen again
  });
  const dropping = (event, on) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", on);
  };
  document.addEventListener("dragover", (event) => dropping(event, true));
  document.addEventListener("dragleave", (event) => event.relatedTarget === null && dropping(event, false));
  document.addEventListener("drop", (event) => {
    dropping(event, false);
    if (event.dataTransfer.files.length > 0) take(event.dataTransfer.files[0], use);
  });
}

/** The character beside the page. */
export async function shippedCharacter(use) {
  const answer = await fetch("./character.glb");
  if (!answer.ok) return showProblem("character", "character.glb is not beside this page; choose one of your own.");
  await take(new File([await answer.blob()], "character.glb"), use);
}

async function take(file, use) {
  try {
    checkSize(file.size);
    const character = await readCharacter(await file.arrayBuffer(), file.name);
    use(character);
    const { driven, unknown } = character.check;
    const others = unknown.length > 0 ? `; these stay still: ${listed(unknown)}` : "";
    showCharacterLine(`${file.name}: your face moves ${driven.length} of its ${driven.length + unknown.length} shapes${others}`);
    hideProblem("character");
  } catch (error) {
    showProblem("character", `${file.name}: ${error.message}`);
  }
}
