// What the user set, remembered across reloads; what belongs to a person's face by the person's name.

const KEY = "torchface";
const OWN = { groups: {}, gains: {}, centre: null }; // of a person
const START = { gain: 1, smoothing: 0.5, mirror: true, keepFilm: false, person: "", people: {}, names: {}, ...OWN };

export const settings = { ...START, ...remembered() };

/** Keeps what was changed. */
export function keepSettings(changed) {
  Object.assign(settings, changed);
  const { person, groups, gains, centre } = settings;
  if (person) settings.people = { ...settings.people, [person]: { groups, gains, centre } };
  try {
    localStorage.setItem(KEY, JSON.stringify(settings));
  } catch {
    // a browser that keeps nothing, such as in private windows
  }
}

/** Calls when another page of the same address has changed them: each would else write over what the other one set. */
export function onSettings(call) {
  window.addEventListener("storage", ({ key }) => {
    if (key !== KEY) return;
    Object.assign(settings, START, remembered());
    call();
  });
}

/** Takes what was kept of a person; a new one begins with what is usual. */
export function choosePerson(name) {
  const kept = Object.hasOwn(settings.people, name) ? settings.people[name] : {};
  keepSettings({ person: name, ...OWN, ...kept });
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
