// MikkTSpace, as glTF viewers compute it: prints the tangents of triangles given corner by corner, as JSON.
// node tangents.mjs FILE   with {"positions": [...], "normals": [...], "uvs": [...]}, uvs with the origin at the upper left
import { readFile } from "node:fs/promises";
import * as MikkTSpace from "three/addons/libs/mikktspace.module.js";

await MikkTSpace.ready;
const corners = JSON.parse(await readFile(process.argv[2]));
const tangents = MikkTSpace.generateTangents(
  new Float32Array(corners.positions), new Float32Array(corners.normals), new Float32Array(corners.uvs),
);
console.log(JSON.stringify(Array.from(tangents)));
