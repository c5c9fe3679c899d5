// A recording as the iPhone app Live Link Face writes it, and torchface's save_live_link: timecode, 52 weights, rotations.

import { ARKIT } from "./arkit_names.js";
import { headAngles } from "./head_angles.js";

const ROTATIONS = ["Head", "LeftEye", "RightEye"].flatMap((part) => ["Yaw", "Pitch", "Roll"].map((axis) => part + axis));
const HEADER = [
  "Timecode", "BlendshapeCount", ...ARKIT.map((name) => name[0].toUpperCase() + name.slice(1)), ...ROTATIONS,
];

/** The text of the CSV; NaN becomes an empty cell. */
export function liveLinkCsv(take) {
  const rows = take.frames.map(({ seconds, weights, rotation, gaze }) => {
    const numbers = [...weights, ...headAngles(rotation), ...eyeAngles(gaze)];
    return [timecode(seconds, take.rate), ARKIT.length + ROTATIONS.length, ...numbers.map(decimal)].join(",");
  });
  return [HEADER.join(","), ...rows, ""].join("\n");
}

/**
 * Left then right eye, each yaw, pitch, roll, of the graph's gaze (right eye first, to the person's left and up). In the
 * app's own recordings eyes that look to the person's right and down have positive angles.
 */
function eyeAngles([rightAside, rightUp, leftAside, leftUp]) {
  return [-leftAside, -leftUp, 0, -rightAside, -rightUp, 0].map((angle) => (Number.isFinite(angle) ? angle + 0 : 0));
}

/** Hours, minutes, seconds and frames with thousandths. */
function timecode(time, rate) {
  const ticks = Math.round(time * 1000 * rate), seconds = Math.floor(ticks / (1000 * rate)), part = ticks % (1000 * rate);
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
