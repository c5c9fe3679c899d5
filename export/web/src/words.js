// What the page says: problems, what it is doing, and what only a screen reader needs to hear.

const element = (id) => document.getElementById(id);

/** Says what went wrong; `part` names the part of the page, "camera" or "character", whose next success takes it away. */
export function showProblem(part, words) {
  element("problem").firstElementChild.textContent = words;
  element("problem").dataset.with = part;
  element("problem").hidden = false;
}

export function hideProblem(part) {
  if (element("problem").dataset.with === part) element("problem").hidden = true;
}

/** What the camera's side is doing; said again only when it changes. */
export function showStatus(words) {
  if (element("status").textContent !== words) element("status").textContent = words;
}

/** What of the character is on its way, in its place; nothing once it is there. */
export function showLoading(words) {
  element("loading").textContent = words;
  element("loading").hidden = words === "";
}

export function showCharacterLine(words) {
  element("character-line").textContent = words;
}

/** The last notes of what happened. */
export function showNotes(notes) {
  const text = notes.slice(-3).join("\n");
  if (text && element("notes").textContent !== text) element("notes").textContent = text;
}

/** For screen readers: what those who see have before their eyes. */
export function speak(words) {
  element("spoken").textContent = words;
}

element("problem").lastElementChild.addEventListener("click", () => (element("problem").hidden = true));
