// Where the character stands: camera and lights that suit any .glb, drawn when something has changed.

import * as THREE from "three";

import { DrawingPace, drawn, pause } from "./drawing_pace.js";
import { lighten, withoutMetal } from "./lighter_drawing.js";
import { ProcessorMorphing } from "./processor_morphing.js";

const FIELD = 24; // degrees; a portrait lens
const MOST_PIXELS = 2; // for one of the page's: more is work that nobody sees
const SOFTWARE_PIXELS = 250_000; // of a whole drawing without a graphics card, each of one sample: half of them with several take longer
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i; // WebGL without a graphics card

export class Stage {
  #renderer;
  #scene = new THREE.Scene();
  #camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
  #character = null;
  #morphing = null;
  #software = drawsInSoftware();
  #pace = new DrawingPace(1);
  #asked = false;
  #drawing = false;
  #hasDrawn = false;
  #film;

  /**
   * The canvas has an event `drawn` when the first picture of a character is there.
   *
   * @param {HTMLCanvasElement} canvas whose size the page's layout says; throws where there is no WebGL.
   * @param {{width: number, height: number, background: string} | null} film of one that is drawn for a film, by `drawNow`.
   */
  constructor(canvas, film = null) {
    this.#film = film;
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: film !== null || !this.#software, alpha: true });
    if (film !== null) this.#scene.background = new THREE.Color(film.background);
    this.#renderer.toneMapping = THREE.NoToneMapping;
    const key = new THREE.DirectionalLight(0xfff4e8, 2.2), rim = new THREE.DirectionalLight(0xdce8ff, 0.8);
    key.position.set(-0.6, 0.8, 1);
    rim.position.set(0.9, 0.5, -0.6);
    this.#scene.add(key, rim, new THREE.HemisphereLight(0xffffff, 0x9a8476, 1.5));
    if (film === null) new ResizeObserver(() => this.#fit()).observe(canvas);
  }

  /** Puts a character in the place of the one before, which is let go. */
  show(character) {
    this.#character?.dispose();
    this.#character = character;
    withoutMetal(character.root);
    this.#morphing = this.#software ? new ProcessorMorphing(character.root) : null;
    if (this.#software && this.#film === null) lighten(character.root);
    this.#scene.add(character.root);
    this.#fit();
  }

  pose(solved) {
    this.#character?.pose(solved);
    this.draw();
  }

  /** Draws with one of the screen's next pictures: when the drawing before is done, and has left the solver its time. */
  draw() {
    this.#asked = true;
    if (!this.#drawing) this.#drawWhileAsked();
  }

  async #drawWhileAsked() {
    this.#drawing = true;
    try {
      while (this.#asked) {
        await new Promise(requestAnimationFrame);
        this.#asked = false;
        await pause(this.#pace.rest(await this.#drawnNow()));
      }
    } finally {
      this.#drawing = false;
    }
  }

  /** Draws the character as it is posed. */
  drawNow() {
    this.#morphing?.update();
    for (const one of this.#character?.wrinkles ?? []) one.update(this.#renderer);
    this.#renderer.render(this.#scene, this.#camera);
  }

  dispose() {
    this.#character?.dispose();
    this.#renderer.dispose();
  }

  /** Milliseconds that drawing took. */
  async #drawnNow() {
    const began = performance.now();
    if (this.#renderer.getPixelRatio() !== this.#pace.ratio) this.#renderer.setPixelRatio(this.#pace.ratio);
    this.drawNow();
    await drawn(this.#renderer.getContext());
    if (!this.#hasDrawn && this.#character !== null) {
      this.#hasDrawn = true;
      this.#renderer.domElement.dispatchEvent(new Event("drawn"));
    }
    return performance.now() - began;
  }

  #fit() {
    const { clientWidth, clientHeight } = this.#renderer.domElement, { width, height } = this.#film ?? { width: clientWidth, height: clientHeight };
    if (width === 0 || height === 0) return;
    const most = this.#software ? Math.min(1, Math.sqrt(SOFTWARE_PIXELS / (width * height))) : MOST_PIXELS;
    const ratio = this.#film ? 1 : Math.min(most, window.devicePixelRatio);
    this.#pace = new DrawingPace(ratio, this.#software ? ratio : undefined);
    this.#renderer.setPixelRatio(this.#pace.ratio);
    this.#renderer.setSize(width, height, false);
    this.#camera.aspect = width / height;
    if (this.#character !== null) {
      const size = this.#character.box.getSize(new THREE.Vector3());
      const middle = this.#character.box.getCenter(new THREE.Vector3());
      const half = Math.tan((FIELD * Math.PI) / 360);
      const distance = (1.04 * Math.max(size.y, size.x / this.#camera.aspect)) / (2 * half) + size.z / 2;
      this.#camera.position.copy(middle).add(new THREE.Vector3(0, 0, distance));
      this.#camera.lookAt(middle);
      [this.#camera.near, this.#camera.far] = [distance / 50, distance * 20];
    }
    this.#camera.updateProjectionMatrix();
    if (this.#film === null) this.draw();
  }
}

function drawsInSoftware() {
  const context = new OffscreenCanvas(1, 1).getContext("webgl2");
  if (context === null) return false;
  const names = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return SOFTWARE.test(name);
}
