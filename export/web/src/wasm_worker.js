// The graph on the processor: WebAssembly with SIMD, threads where the page is isolated from other origins.

import * as ort from "onnxruntime-web/wasm";

import { answerFrames } from "./frame_answers.js";

answerFrames(ort, "wasm");
