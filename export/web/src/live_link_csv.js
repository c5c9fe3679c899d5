// A recording as the iPhone app Live Link Face writes it, and torchface's save_live_link: timecode, 52 weights, rotations.

import { ARKIT, sourcesOf } from "./arkit_names.js";
import { headAngles, headRotation } from "./head_angles.js";
import { LONGEST, Take } from "./take.js";

const ROTATIONS = ["Head", "LeftEye", "RightEye"].flatMap((part) => ["Yaw", "Pitch", "Roll"].map((axis) => part + axis));
const BASE = 60; // frames of a second of the timecode, which count thousandths: readers take it whatever the steps
const BASES = [BASE, 15, 20, 24, 25, 30, 48, 50, 72, 90, 96, 100, 120, 240]; // of others; the first where nothing says which
const HEADER = [
  "Timecode", "BlendshapeCount", ...ARKIT.map((name) => name[0].toUpperCase() + name.slice(1)), ...ROTATIONS,
];

/** The text of the CSV; NaN becomes an empty cell. */
export function liveLinkCsv(take) {
  const rows = take.frames.map(({ seconds, weights, rotation, gaze }) => {
    const numbers = [...weights, ...headAngles(rotation), ...eyeAngles(gaze)];
    return [timecode(seconds), ARKIT.length + ROTATIONS.length, ...numbers.map(decimal)].join(",");
  });
  return [HEADER.join(","), ...rows, ""].join("\n");
}

/**
 * The take of a CSV with ARKit's shapes: of Live Link Face with its timecode, or of torchface with `time` in seconds.
 *
 * @throws {Error} in plain words where it is none.
 */
export function readLiveLinkCsv(text) {
  const [header, ...lines] = text.split(/\r?\n/).filter((line) => line.trim());
  const names = (header ?? "").replace(/[,\s]+$/, "").split(",").map((name) => name.trim());
  const column = new Map(names.map((name, i) => [name.toLowerCase(), i]));
  const shapes = names.flatMap((name, i) => sourcesOf(name).map(([row]) => [row, i]));
  const clock = column.get("timecode"), time = column.get("time");
  if (shapes.length === 0 || (clock ?? time) === undefined)
    throw new Error("this is no recording of ARKit's shapes. A .csv of Live Link Face or of torchface begins with Timecode or frame,time and their names.");
  const rows = lines.map((line) => line.split(","));
  const seconds = clock === undefined ? rows.map((row) => Number(row[time])) : clockSeconds(rows.map((row) => row[clock]));
  const numbers = [...shapes.map(([, i]) => i), ...ROTATIONS.flatMap((name) => column.get(name.toLowerCase()) ?? [])];
  const cut = (row) => row.length < names.length && row[column.get("blendshapecount")]?.trim() !== "0"; // of no face the app's are
  const wrong = rows.findIndex((row, frame) => cut(row) || [seconds[frame], ...numbers.map((i) => row[i] ?? 0)].some((cell) => !Number.isFinite(Number(cell))));
  if (wrong >= 0) throw new Error(`row ${wrong + 2} is cut short, or its time, a weight or an angle is no number.`);
  const take = new Take();
  rows.forEach((row, frame) => {
    const number = (name) => Number(row[column.get(name.toLowerCase())] ?? 0);
    const angles = (part) => ["Yaw", "Pitch", "Roll"].map((axis) => number(part + axis));
    const weights = new Float32Array(ARKIT.length);
    for (const [shape, i] of shapes) weights[shape] = Math.min(1, Math.max(0, Number(row[i] ?? 0)));
    const [left, right] = [angles("LeftEye"), angles("RightEye")];
    const gaze = Float32Array.of(-right[0], -right[1], -left[0], -left[1]);
    take.add(1000 * seconds[frame], { weights, rotation: headRotation(angles("Head")), gaze });
  });
  if (take.frames.length === 0 || take.duration > LONGEST) throw new Error("its times are missing, do not rise, or are longer than an hour.");
  return take;
}

function clockSeconds(texts) {
  const clocks = texts.map((text) => (text ?? "").split(/[:;]/).map(Number));
  const base = clockBase(clocks);
  return clocks.map(([hours, minutes, seconds, frames]) => 3600 * hours + 60 * minutes + seconds + frames / base);
}

/** Up to which number frames count: where a second ends they fall by it, less a usual step, as torchface's reader has it. */
function clockBase(clocks) {
  const most = clocks.reduce((all, clock) => Math.max(all, clock[3] || 0), 0), bases = BASES.filter((base) => base > most);
  const pairs = clocks.slice(1).map((clock, i) => [clock[2] - clocks[i][2], clock[3] - clocks[i][3]]);
  const steps = pairs.filter(([seconds, step]) => seconds === 0 && step > 0).map(([, step]) => step).sort((a, b) => a - b);
  const falls = pairs.filter(([seconds, step]) => (seconds === 1 || seconds === -59) && step < 0).map(([, step]) => -step);
  if (!steps.length || !falls.length || !bases.length) return bases[0] ?? 1000;
  const [least, largest] = [steps[0], steps.at(-1)];
  const off = (over) => (over <= 0 ? Infinity : Math.max(0, least - over, over - largest));
  const faults = bases.map((base) => falls.reduce((all, fall) => all + off(base - fall), 0) / falls.length);
  const allowed = Math.min(...faults) + steps[steps.length >> 1] / 2;
  return bases[faults.findIndex((fault) => fault <= allowed)] ?? 1000;
}

/**
 * Left then right eye, each yaw, pitch, roll, of the graph's gaze (right eye first, to the person's left and up). In the
 * app's own recordings eyes that look to the person's right and down have positive angles.
 */
function eyeAngles([rightAside, rightUp, leftAside, leftUp]) {
  return [-leftAside, -leftUp, 0, -rightAside, -rightUp, 0].map((angle) => (Number.isFinite(angle) ? angle + 0 : 0));
}

/** Hours, minutes, seconds and frames with thousandths. */
function timecode(time) {
  const ticks = Math.round(time * 1000 * BASE), seconds = Math.floor(ticks / (1000 * BASE)), part = ticks % (1000 * BASE);
  const two = (number) => String(number).padStart(2, "0");
  const clock = [Math.floor(seconds / 3600) % 24, Math.floor(seconds / 60) % 60, seconds % 60, Math.floor(part / 1000)];
  return `${clock.map(two).join(":")}.${String(part % 1000).padStart(3, "0")}`;
}

/** Ten decimals as the app writes them, more digits where these do not give a float32 back. */
function decimal(value) {
  if (Number.isNaN(value)) return "";
  const text = value.toFixed(10);
  return Math.fround(Number(text)) === Math.fround(value) ? text : value.toPrecision(9);
}
