// The page: camera, solver, character and controls put together.

import "./style.css";

import { Calibration, tone } from "./calibration.js";
import { closeCamera, openCamera } from "./camera.js";
import { offerCharacters, shippedCharacter } from "./character_choice.js";
import { drawFace } from "./face_overlay.js";
import { pumpFrames } from "./frame_pump.js";
import { FrameRate } from "./frame_rate.js";
import { Recording } from "./recording.js";
import { Solver } from "./solver.js";
import { Stage } from "./stage.js";
import { hideProblem, showProblem, showStatus, speak } from "./words.js";

const SEEN = 0.5; // of presence; below it there is no face
const GONE = 1000; // milliseconds without a face until that is said

const element = (id) => document.getElementById(id);
const rate = new FrameRate();
const recording = new Recording(() => character);
let character = null, stage = null, calibration = null;
let solver = null, loading = null, stream = null, pump = null;
let resetAsked = false, lastSeen = 0;

const controls = () => {
  const reset = resetAsked;
  resetAsked = false;
  const value = (id) => Number(element(id).value);
  return { pose: calibration?.pose ?? 0, gain: value("gain"), smoothing: value("smoothing"), reset };
};

async function start() {
  element("start").disabled = true;
  hideProblem("camera");
  try {
    showStatus("Asking for the camera…");
    const loaded = loadedSolver(); // while the user is asked
    loaded.catch(() => {}); // said once the camera is there
    stream = await openCamera(element("video"), () => stop("The camera was unplugged or taken away."));
    element("invitation").hidden = true;
    showStatus("Loading the solver…");
    await loaded;
    if (stream !== null) run(); // else it was taken away meanwhile
  } catch (error) {
    stop(error.message);
  }
  element("start").disabled = false;
}

function run() {
  pump = pumpFrames(element("video"), solver, controls, show, (error) => {
    forgetSolver();
    stop(`The solver stopped: ${error.message}`);
  });
  setRunning(true);
}

/** The solver, which is loaded once; after a failure once more. */
async function loadedSolver() {
  loading ??= (solver = new Solver()).load("./webcam.onnx");
  try {
    await loading;
  } catch (error) {
    forgetSolver();
    throw new Error(`The solver could not be loaded: ${error.message}.`);
  }
}

function forgetSolver() {
  solver?.close();
  solver = loading = null;
}

function stop(problem = null) {
  pump?.stop();
  if (stream !== null) closeCamera(element("video"), stream);
  pump = stream = null;
  endCalibration();
  recording.stop();
  rate.forget();
  drawFace(element("overlay"), null);
  setRunning(false);
  showStatus("");
  if (problem) showProblem("camera", problem);
}

function setRunning(running) {
  element("start").textContent = running ? "Stop camera" : "Start camera";
  element("start").classList.toggle("first", !running);
  element("invitation").hidden = running;
  for (const id of ["calibrate", "reset", "record"]) element(id).disabled = !running;
  lastSeen = performance.now();
}

function show(solved) {
  const seen = solved.presence > SEEN;
  if (seen) lastSeen = performance.now();
  const gone = performance.now() - lastSeen > GONE;
  if (!document.hidden) // else this is the picture that was under way, and the pause has been said
    showStatus(gone ? "No face is seen. Move into the picture, with light on your face." : "Your face is followed.");
  rate.add(solved.milliseconds);
  drawFace(element("overlay"), seen ? solved : null);
  stage?.pose(solved);
  recording.add(solved);
  if (calibration !== null) goOnCalibrating(solved.time, seen);
}

function goOnCalibrating(time, seen) {
  const step = calibration.advance(time, seen);
  element("prompt-progress").value = calibration.progress;
  if (step === "same") return;
  tone();
  if (step === "done") {
    endCalibration();
    speak("Calibrated");
  } else showPrompt();
}

function showPrompt() {
  element("prompt-words").textContent = `${calibration.number} of ${Calibration.count}: ${calibration.prompt}`;
  speak(calibration.prompt);
}

function startCalibration() {
  calibration = new Calibration();
  element("prompt").hidden = false;
  element("prompt-progress").value = 0;
  showPrompt();
  element("prompt-stop").focus();
}

function endCalibration() {
  if (calibration === null) return;
  const focused = element("prompt").contains(document.activeElement);
  calibration = null;
  element("prompt").hidden = true;
  if (focused) element("calibrate").focus();
}

function showRate() {
  const now = rate.get();
  const threads = solver?.facts?.threads > 1 ? `, ${solver.facts.threads} threads` : "";
  element("rate").value = now ? `${now.perSecond.toFixed(0)} frames a second, ${now.milliseconds.toFixed(0)} ms each${threads}` : "";
}

element("start").addEventListener("click", () => (stream === null ? start() : stop()));
element("calibrate").addEventListener("click", startCalibration);
element("prompt-stop").addEventListener("click", endCalibration);
element("reset").addEventListener("click", () => {
  resetAsked = true;
  speak("Begun anew");
});
element("mirror").addEventListener("change", ({ target }) => {
  for (const view of document.querySelectorAll(".view")) view.classList.toggle("mirrored", target.checked);
});
for (const id of ["gain", "smoothing"])
  element(id).addEventListener("input", ({ target }) => (element(`${id}-value`).value = Number(target.value).toFixed(1)));
document.addEventListener("keydown", ({ key }) => key === "Escape" && endCalibration());
document.addEventListener("visibilitychange", () => {
  if (pump !== null) showStatus(document.hidden ? "Paused while this tab is hidden." : "");
  lastSeen = performance.now();
});
setInterval(showRate, 500);

try {
  stage = new Stage(element("character"));
} catch {
  element("undrawn").hidden = false;
}
const use = (chosen) => {
  character = chosen;
  stage?.show(chosen);
};
offerCharacters(use);
shippedCharacter(use).catch((error) => showProblem("character", `The character could not be loaded: ${error.message}.`));
