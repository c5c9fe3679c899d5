// ARKit's 52 blendshapes in Live Link Face's order, which is the graph's, and what other rigs call the same shapes.

import { MOODS, RECOGNISED, VOWELS } from "./shape_tables.js";

const both = (...names) => names.flatMap((name) => [`${name}Left`, `${name}Right`]);
const eye = (side) =>
  ["Blink", "LookDown", "LookIn", "LookOut", "LookUp", "Squint", "Wide"].map((name) => `eye${name}${side}`);

export const ARKIT = Object.freeze([
  ...eye("Left"), ...eye("Right"),
  "jawForward", "jawRight", "jawLeft", "jawOpen",
  "mouthClose", "mouthFunnel", "mouthPucker", "mouthRight", "mouthLeft",
  ...both("mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch"),
  "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper",
  ...both("mouthPress", "mouthLowerDown", "mouthUpperUp", "browDown"),
  "browInnerUp", ...both("browOuterUp"), "cheekPuff", ...both("cheekSquint", "noseSneer"), "tongueOut",
]);

/** One spelling for a shape: `EyeBlinkLeft`, `eyeBlink_L` and `eyeblinkleft` are the same. */
const canonical = (name) =>
  name.replace(/_(L|R)$/, (_, side) => (side === "L" ? "Left" : "Right")).toLowerCase();

const ROW = new Map(ARKIT.map((name, row) => [canonical(name), row]));

const PREFIX = /^(.*__(?=facs_)|.*(?=Fcl_)(?<!^)|.*[.:|](?=[^.:|]{3,}$)|(?:facs_)?(?:bs|jnt|ctrl|cbs)_|facs_|[at]\d\d_|arkit[_ ]|au\d+_(?=[a-z]{3})|(?:head|face|blendshapes?|bs)\d*_(?=[a-z]))/i;
const SUFFIX = /(_div\d+|_hd\d*|\.\d{3})$/i;
const SPELLING = { eyes: "eye", brows: "brow", eyebrow: "brow", eyebrows: "brow", lips: "lip", l: "left", r: "right", lf: "left", lt: "left", rt: "right" };
const BY_WORDS = new Map(Object.entries(RECOGNISED).flatMap(([name, all]) => all.map((words) => [words, name])));

/** ARKit's name of a shape that another program has named, as torchface's `shape_names.arkit_name`. */
export function arkitName(name) {
  for (let before = ""; before !== name; ) [before, name] = [name, name.replace(SUFFIX, "").replace(PREFIX, "")];
  const words = (name.match(/[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+/g) ?? []).map((word) => SPELLING[word.toLowerCase()] ?? word.toLowerCase());
  return BY_WORDS.get(words.join(" ")) ?? BY_WORDS.get(words.sort().join(" "));
}

/**
 * What a shape takes of ARKit's weights, as torchface's `shape_names.mapping`: a whole shape drives both halves of a
 * split one, two halves give the whole their mean. Names of other programs count as those of ARKit that they mean.
 *
 * @returns {[number, number][]} rows of ARKIT and their factors; none for a shape that ARKit does not know.
 */
export function sourcesOf(name) {
  const wanted = canonical(name);
  if (ROW.has(wanted)) return [[ROW.get(wanted), 1]];
  const halves = [`${wanted}left`, `${wanted}right`];
  if (halves.every((half) => ROW.has(half))) return halves.map((half) => [ROW.get(half), 0.5]);
  const whole = wanted.replace(/(left|right)$/, "");
  if (whole !== wanted && ROW.has(whole)) return [[ROW.get(whole), 1]];
  const known = arkitName(name);
  return known === undefined || canonical(known) === wanted ? [] : sourcesOf(known);
}

const VOWEL = /^(?:fcl_mth_|vrc[._]v_)(a|i|u|e|o|aa|ih|ou|oh)$/;
const CLIPS = { a: "aa", i: "ih", u: "ou", e: "ee", o: "oh" };

/** The rule of a vowel's shape, or of one for a mood, as torchface's `vowel_sources`; none for another shape. */
export function vowelRule(name) {
  const plain = name.slice(Math.max(0, name.indexOf("Fcl_"))).toLowerCase(), vowel = VOWEL.exec(plain)?.[1];
  const sources = vowel ? VOWELS[CLIPS[vowel] ?? vowel] : MOODS[plain];
  return sources && { sum: Object.entries(sources).map(([arkit, factor]) => [ARKIT.indexOf(arkit), factor]), product: [], gain: 1, lower: 0, upper: 1 };
}

/** The weight of a shape of ARKit's weights: by its sources, by a rule of torchface's mapping tables, or as a corrective. */
export function weightOf({ sources, rule, drivers, knots }, weights) {
  if (drivers) {
    const product = drivers.reduce((all, one) => all * weightOf(one, weights), 1);
    if (!knots) return product;
    const [left, peak, right] = knots; // an in-between: up to its peak, then down
    return Math.max(0, Math.min((product - left) / (peak - left), (right - product) / (right - peak)));
  }
  const sum = (rule?.sum ?? sources).reduce((all, [row, factor]) => all + factor * weights[row], 0);
  if (!rule) return sum;
  const product = rule.product.reduce((all, row) => all * weights[row], 1);
  return Math.min(rule.upper, Math.max(rule.lower, rule.gain * (rule.sum.length > 0 || rule.product.length === 0 ? sum : 1) * product));
}
