// Khronos' validator: prints its report on a .glb as JSON.
import { readFile } from "node:fs/promises";
import { validateBytes } from "gltf-validator";

const bytes = new Uint8Array(await readFile(process.argv[2]));
const report = await validateBytes(bytes, { maxIssues: 50 });
console.log(JSON.stringify(report));
