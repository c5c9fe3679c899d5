// The nodes of a character that a head, a neck, eyes and arms have: by VRM's own table, else by their names.

const WORD = String.raw`(?:^|[_ :.]|mixamorig)`;
const name = (pattern) => new RegExp(`${WORD}(?:${pattern})$`, "i");
const sided = (side, other, part) => name(`${side}_?${part}|${part}[_.]?${other}|${part}[_.]?${side}|${other}_${part}`);
const EYE = "eye(?:ball)?", ARM = "(?:upper_?)?arm", NEXT = "(?:fore_?arm|lower_?arm)";
const NAMES = {
  head: name("head"), neck: name("neck(?:_?0?1)?"),
  rightEye: sided("right", "r", EYE), leftEye: sided("left", "l", EYE),
  rightUpperArm: sided("right", "r", ARM), leftUpperArm: sided("left", "l", ARM),
  rightLowerArm: sided("right", "r", NEXT), leftLowerArm: sided("left", "l", NEXT),
};

/** Node of each part by VRM's names of bones, where there is one; eyes may be nodes that are no bones. */
export function characterBones({ nodes = [], skins = [], extensions = {} }) {
  const one = extensions.VRMC_vrm?.humanoid?.humanBones, zero = extensions.VRM?.humanoid?.humanBones;
  const table = one ? Object.fromEntries(Object.entries(one).map(([part, { node }]) => [part, node]))
    : Array.isArray(zero) ? Object.fromEntries(zero.map(({ bone, node }) => [bone, node])) : {};
  const joints = new Set(skins.flatMap((skin) => skin.joints ?? []));
  const found = {};
  for (const [part, pattern] of Object.entries(NAMES)) {
    const named = nodes.findIndex((node, index) => (joints.has(index) || part.endsWith("Eye")) && pattern.test(node.name ?? ""));
    const node = table[part] ?? named;
    if (Number.isInteger(node) && node in nodes) found[part] = node;
  }
  return found;
}

/** Whether a character looks along -z at rest, as VRM 0 has it. */
export const looksBack = ({ extensions = {} }) => "VRM" in extensions && !("VRMC_vrm" in extensions);
