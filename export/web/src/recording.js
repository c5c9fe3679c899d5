// Record, stop, and what comes of it: a CSV, and the character with the recording inside.

import { animatedGlb } from "./glb_animation.js";
import { liveLinkCsv } from "./live_link_csv.js";
import { Take } from "./take.js";
import { showProblem, speak } from "./words.js";

const element = (id) => document.getElementById(id);

export class Recording {
  #take = new Take();
  #character;
  running = false;

  /** @param {() => object | null} character the one that is shown, for its .glb. */
  constructor(character) {
    this.#character = character;
    element("record").addEventListener("click", () => (this.running ? this.stop() : this.start()));
    element("csv").addEventListener("click", () => this.#give("csv", () => liveLinkCsv(this.#take), "text/csv"));
    element("glb").addEventListener("click", () => this.#give("glb", () => this.#animation(), "model/gltf-binary"));
  }

  start() {
    this.#take = new Take();
    this.#set(true);
    speak("Recording");
  }

  stop() {
    if (!this.running) return;
    this.#set(false);
    speak(element("recorded").textContent);
  }

  /** Takes a frame while it runs; an hour is the most. */
  add(solved) {
    if (!this.running) return;
    this.#take.add(solved.time, solved);
    this.#tell();
    if (this.#take.full) this.stop();
  }

  #set(running) {
    this.running = running;
    element("record").setAttribute("aria-pressed", String(running));
    element("record").textContent = running ? "Stop recording" : "Record";
    for (const id of ["csv", "glb"]) element(id).disabled = running || this.#take.frames.length === 0;
    this.#tell();
  }

  #tell() {
    const { duration, frames } = this.#take;
    const some = `${duration.toFixed(1)} s, ${frames.length} frames`;
    element("recorded").textContent = frames.length > 0 || this.running ? some : "Nothing recorded yet";
  }

  #animation() {
    const character = this.#character();
    return animatedGlb(character.check, this.#take, character.turnedNodes(this.#take));
  }

  #give(ending, made, type) {
    try {
      const address = URL.createObjectURL(new Blob([made()], { type }));
      const link = Object.assign(document.createElement("a"), { href: address, download: `torchface.${ending}` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(address), 60_000); // the browser may ask first where to put it
    } catch (error) {
      showProblem("character", error.message);
    }
  }
}
