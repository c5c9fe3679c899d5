// The page: engine, character and controls put together. The engine runs in this browser, or in Python behind a socket.

import "./style.css";

import { Calibration, tone } from "./calibration.js";
import { CameraEngine } from "./camera_engine.js";
import { offerCharacters, shippedCharacter, tellCharacter } from "./character_choice.js";
import { drawFace } from "./face_overlay.js";
import { FrameRate } from "./frame_rate.js";
import { offerGroups } from "./group_settings.js";
import { ServerEngine } from "./server_engine.js";
import { changedNames, giveNames, offerNames } from "./shape_name_table.js";
import { choosePerson, keepSettings, onSettings, settings } from "./settings.js";
import { Stage } from "./stage.js";
import { StateWords, isSeen } from "./state_words.js";
import { isStream, layOutStream } from "./stream_view.js";
import { TakeList } from "./take_list.js";
import { shapeSettings, WeightControls } from "./weight_controls.js";
import { hideProblem, showLoading, showNotes, showProblem, showStatus, speak } from "./words.js";

const NEUTRAL = { ...shapeSettings({}), centre: null, frozen: false };
const element = (id) => document.getElementById(id);
const server = document.documentElement.dataset.engine === "server", stream = isStream();
const INVITATION = server ? "" : "Start the camera to begin.";
const rate = new FrameRate(), words = new StateWords();
let character = null, stage = null, calibration = null;
let newest = null; // as it was solved, before what the user set
let frozen = false, said = "", noted = "", loading = "";
let weights = null; // what the user set of weights

const mirrored = (stream ? layOutStream() : null) ?? settings.mirror;

function invite() {
  showStatus(said || loading || INVITATION);
}

function collect() {
  weights = calibration ? NEUTRAL : { ...shapeSettings(settings.groups, settings.gains), centre: settings.centre, frozen };
}

const page = {
  controls: () => ({
    solver: { pose: calibration?.pose ?? 0, gain: settings.gain, smoothing: settings.smoothing },
    weights,
  }),
  show(wanted, solved) {
    newest = solved;
    rate.add(solved);
    if (!takes.playing) stage?.pose(wanted);
    if (stream) return;
    const seen = isSeen(solved);
    if (!document.hidden) showStatus(said || words.of(solved, settings.mirror)); // else the pause has been said
    drawFace(element("overlay"), seen ? solved : null);
    takes.tell();
    if (calibration !== null) goOnCalibrating(solved, seen);
  },
  running(on) {
    document.documentElement.dataset.running = on ? "on" : "off";
    element("start").textContent = on ? "Stop camera" : "Start camera";
    element("start").classList.toggle("first", !on);
    element("invitation").hidden = on;
    for (const id of ["calibrate", "reset", "record", "recenter", "freeze"]) element(id).disabled = !on;
    words.forget();
    if (on) return;
    endCalibration();
    takes.stop();
    rate.forget();
    drawFace(element("overlay"), null);
    invite();
  },
  status: showStatus,
  /** What of the engine is on its way while the camera is off. */
  loading(words) {
    loading = words;
    if (!engine.running) invite();
  },
  problem: (what) => showProblem("camera", what),
  takesChanged: () => takes.refresh(),
  /** What torchface says of itself, beside the frames. */
  state({ words: told = "", notes = [], ended = "", calibrate = false }) {
    said = ended || told;
    if (ended || !engine.running) invite();
    if (notes.join("\n") !== noted) showNotes(notes); // else what this page has noted since would go
    noted = notes.join("\n");
    if (calibrate && calibration === null && !stream) startCalibration();
  },
};

const engine = server ? new ServerEngine(page, element("picture")) : new CameraEngine(page, element("video"));
const playing = new WeightControls();
const takes = new TakeList(engine.takes, () => character, (frame) => stage?.pose(playing.apply(frame, NEUTRAL)));

function goOnCalibrating({ time, weights: seenWeights }, seen) {
  const step = calibration.advance(time, seen, seenWeights);
  element("prompt-progress").value = calibration.progress;
  element("prompt-remark").textContent = calibration.remark;
  if (step === "same") return;
  tone();
  if (step === "done") {
    const { result, gains } = calibration;
    keepSettings({ gains: { ...settings.gains, ...gains } }); // of a pose that was not seen, what was found before
    endCalibration();
    showNotes([result]);
    speak(result);
  } else showPrompt(step === "again" ? "Once more, it was not seen: " : "");
}

function showPrompt(before = "") {
  element("prompt-words").textContent = `${calibration.number} of ${Calibration.count}: ${calibration.prompt}`;
  speak(before + calibration.prompt);
}

function startCalibration() {
  calibration = new Calibration();
  collect();
  element("prompt").hidden = false;
  element("prompt-progress").value = 0;
  showPrompt();
  element("prompt-stop").focus({ preventScroll: true });
  element("prompt").scrollIntoView({ block: "nearest" }); // on a phone it may be above, with its words above the button
}

function endCalibration() {
  if (calibration === null) return;
  const focused = element("prompt").contains(document.activeElement);
  calibration = null;
  collect();
  element("prompt").hidden = true;
  if (focused) element("calibrate").focus();
}

function recenter() {
  if (newest === null || !newest.rotation.every(Number.isFinite)) return;
  keepSettings({ centre: { rotation: [...newest.rotation], gaze: [...newest.gaze] } });
  collect();
  speak("Head and gaze are centred");
}

function freeze() {
  frozen = !frozen;
  element("freeze").setAttribute("aria-pressed", String(frozen));
  collect();
}

function setMirror(on) {
  for (const view of document.querySelectorAll(".view")) view.classList.toggle("mirrored", on);
}

function showRate() {
  const now = rate.get(), threads = engine.threads > 1 ? `, ${engine.threads} threads` : "";
  element("rate").value = now ? `${now.perSecond.toFixed(0)} frames a second, ${now.milliseconds.toFixed(0)} ms${threads}` : "";
}

element("start").addEventListener("click", async () => {
  if (engine.running) return engine.stop();
  element("start").disabled = true;
  hideProblem("camera");
  await engine.start();
  element("start").disabled = false;
});
element("calibrate").addEventListener("click", startCalibration);
element("prompt-stop").addEventListener("click", endCalibration);
element("recenter").addEventListener("click", recenter);
element("freeze").addEventListener("click", freeze);
element("save-names").addEventListener("click", () => character && giveNames(character));
element("reset").addEventListener("click", () => {
  engine.reset();
  keepSettings({ gains: {}, centre: null });
  collect();
  speak("Begun anew");
});
function showSettings() {
  element("person").value = settings.person;
  element("people").replaceChildren(...Object.keys(settings.people).map((name) => Object.assign(document.createElement("option"), { value: name })));
  offerGroups(element("groups"), collect);
  element("mirror").checked = settings.mirror;
  for (const id of ["gain", "smoothing"]) {
    element(id).value = settings[id];
    element(`${id}-value`).value = settings[id].toFixed(1);
  }
}
onSettings(() => {
  if (stream) return;
  collect();
  setMirror(settings.mirror);
  showSettings();
});
element("person").addEventListener("change", ({ target }) => {
  choosePerson(target.value.trim());
  if (engine.running) engine.reset();
  collect();
  showSettings();
});
element("mirror").addEventListener("change", ({ target }) => {
  keepSettings({ mirror: target.checked });
  setMirror(target.checked);
});
for (const id of ["gain", "smoothing"])
  element(id).addEventListener("input", ({ target }) => {
    keepSettings({ [id]: Number(target.value) });
    element(`${id}-value`).value = settings[id].toFixed(1);
  });
document.addEventListener("keydown", ({ key, target, ctrlKey, metaKey, altKey }) => {
  if (key === "Escape") return endCalibration();
  if (ctrlKey || metaKey || altKey || target.matches?.("input:not([type=range], [type=checkbox])")) return;
  if (key === "c") recenter();
  if (key === "f" && engine.running) freeze();
});
document.addEventListener("visibilitychange", () => {
  if (engine.running && !server) showStatus(document.hidden ? "Paused while this tab is hidden." : "");
  words.forget();
});
setInterval(showRate, 500);

collect();
setMirror(mirrored);
showSettings();
try {
  stage = new Stage(element("character"));
} catch {
  element("undrawn").hidden = false;
  showLoading("");
}
const use = (chosen) => {
  character = chosen;
  stage?.show(chosen);
  if (newest !== null) stage?.pose(newest);
  if (stream) return;
  tellCharacter(chosen);
  offerNames(element("names"), chosen, async () => use(await chosen.again(changedNames(chosen.name))));
  engine.nameShapes?.(element("own").hidden ? changedNames(chosen.name) : {});
};
if (!stream) offerCharacters(use, (file) => takes.take(file));
element("character").addEventListener("drawn", () => showLoading(""));
let prepared = server || stream;
/** Begins to load the engine, once the character is here: on a slow line it would be seen much later otherwise. */
function prepare() {
  if (!prepared) engine.prepare();
  prepared = true;
}
shippedCharacter(use, true, (bytes, all) => {
  if (stage !== null) showLoading(all ? "Preparing the character…" : `Loading the character: ${(bytes / 1e6).toFixed(1)} MB are here…`);
  if (all) prepare();
})
  .catch((error) => showProblem("character", `The character could not be loaded: ${error.message}.`))
  .finally(() => {
    prepare();
    if (character === null) showLoading("");
  });
takes.refresh();
if (server || stream) engine.start();
else invite();
