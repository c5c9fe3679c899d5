// A take as files of other programs; what only some of them need is loaded when it is asked for.

import { animatedGlb } from "./glb_animation.js";
import { liveLinkCsv } from "./live_link_csv.js";
import { vrmAnimation } from "./vrm_animation.js";

/** What makes each kind of file of a take and a character, with the name that the browser gives it. */
export const KINDS = {
  ".csv": (take) => liveLinkCsv(take),
  ".glb": (take, character) => animatedGlb(character.check, take, character.turnedNodes(take)),
  ".vrma": (take, character) => vrmAnimation(take, character.check),
  ".usdz": async (take, character) => (await import("./usd_package.js")).usdPackage(await character.again(), take),
  ".mp4": async (take, character, progress) => {
    const background = getComputedStyle(document.querySelector(".view")).backgroundColor;
    return (await import("./take_film.js")).takeFilm(await character.again(), take, background, progress);
  },
};

const TYPES = { ".csv": "text/csv", ".glb": "model/gltf-binary", ".vrma": "model/gltf-binary", ".usdz": "model/vnd.usdz+zip", ".mp4": "video/mp4" };

/** Gives a file to the user. */
export function give(name, suffix, made) {
  const address = URL.createObjectURL(new Blob([made], { type: TYPES[suffix] ?? made.type }));
  Object.assign(document.createElement("a"), { href: address, download: name.replace(/[\\/:*?"<>|]/g, "-") + suffix }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000); // the browser may ask first where to put it
}
