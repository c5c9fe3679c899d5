// The table of what a character's shapes are called and which of ARKit's each means; what is changed is kept by character.

import { ARKIT } from "./arkit_names.js";
import { keepSettings, settings } from "./settings.js";
import { give } from "./take_files.js";

const AS_FOUND = "as found";

/** What was changed of a character: ARKit's name, or none for a shape that stays still, by the shape's name. */
export const changedNames = (character) => (Object.hasOwn(settings.names, character) ? settings.names[character] : {});

/**
 * Fills the table's body.
 *
 * @param {Character} character that is shown.
 * @param {() => void} changed called when a name means another shape.
 */
export function offerNames(body, character, changed) {
  const shapes = [...new Map([...character.check.meshes.values()].flat().map((shape) => [shape.name, shape])).values()].filter(({ drivers }) => !drivers);
  const kept = changedNames(character.name);
  body.replaceChildren(
    ...shapes.map(({ name, sources }) => {
      const row = document.createElement("tr"), cell = document.createElement("td");
      const title = Object.assign(document.createElement("th"), { scope: "row", textContent: name });
      const select = document.createElement("select"), own = Object.hasOwn(kept, name);
      const means = sources.map(([arkit]) => ARKIT[arkit]).join(", ") || "stays still";
      select.setAttribute("aria-label", `${name} means`);
      select.append(new Option(own ? "as its name says" : means, AS_FOUND), new Option("stays still", ""), ...ARKIT.map((arkit) => new Option(arkit, arkit)));
      select.value = own ? kept[name] : AS_FOUND;
      select.addEventListener("change", () => {
        const { [name]: before, ...others } = changedNames(character.name);
        const now = select.value === AS_FOUND ? others : { ...others, [name]: select.value };
        keepSettings({ names: { ...settings.names, [character.name]: now } });
        changed();
      });
      cell.append(select);
      row.append(title, cell);
      return row;
    }),
  );
}

/** Gives the table as torchface's --mapping takes it. */
export function giveNames(character) {
  const shapes = new Map([...character.check.meshes.values()].flat().map(({ name, sources }) => [name, sources]));
  const lines = [...shapes].filter(([, sources]) => sources.length > 0).map(([name, sources]) =>
    `[${JSON.stringify(name)}]\nsum = {${sources.map(([row, factor]) => `${ARKIT[row]} = ${factor.toFixed(4)}`).join(", ")}}\n`);
  give(character.name.replace(/\.\w+$/, ""), ".toml", lines.join("\n"));
}
