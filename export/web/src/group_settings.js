// The table of gain, dead zone, smoothing and mute of each group of shapes.

import { keepSettings, settings } from "./settings.js";
import { GROUPS, USUAL } from "./weight_controls.js";

const RANGES = [["gain", 0, 2, 0.05], ["dead", 0, 0.5, 0.01], ["smoothing", 0, 1, 0.05]];
const LABELS = { gain: "gain", dead: "dead zone", smoothing: "smoothing" };

/** Fills the table's body; what is set is kept. */
export function offerGroups(body, changed) {
  const set = (group, values) => {
    keepSettings({ groups: { ...settings.groups, [group]: { ...USUAL, ...settings.groups[group], ...values } } });
    changed();
  };
  body.replaceChildren(
    ...Object.keys(GROUPS).map((group) => {
      const now = { ...USUAL, ...settings.groups[group] }, row = document.createElement("tr");
      const title = Object.assign(document.createElement("th"), { scope: "row", textContent: group });
      const inputs = RANGES.map(([name, min, max, step]) => {
        const input = Object.assign(document.createElement("input"), { type: "range", min, max, step, value: now[name] });
        input.setAttribute("aria-label", `${group}: ${LABELS[name]}`);
        input.addEventListener("input", () => set(group, { [name]: Number(input.value) }));
        return input;
      });
      const mute = Object.assign(document.createElement("input"), { type: "checkbox", checked: now.muted });
      mute.setAttribute("aria-label", `${group}: mute`);
      mute.addEventListener("change", () => set(group, { muted: mute.checked }));
      row.append(title, ...[...inputs, mute].map((input) => {
        const cell = document.createElement("td");
        cell.append(input);
        return cell;
      }));
      return row;
    }),
  );
}
