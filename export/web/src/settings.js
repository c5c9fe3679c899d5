// What the user set, remembered across reloads.

const KEY = "torchface";
const START = { gain: 1, smoothing: 0.5, mirror: true, groups: {}, gains: {}, centre: null };

export const settings = { ...START, ...remembered() };

/** Keeps what was changed. */
export function keepSettings(changed) {
  Object.assign(settings, changed);
  try {
    localStorage.setItem(KEY, JSON.stringify(settings));
  } catch {
    // a browser that keeps nothing, such as in private windows
  }
}

function remembered() {
  try {
    const found = JSON.parse(localStorage.getItem(KEY) ?? "{}");
    const known = Object.entries(found).filter(([name, value]) => name in START && (START[name] === null || typeof value === typeof START[name]));
    return Object.fromEntries(known);
  } catch {
    return {};
  }
}
