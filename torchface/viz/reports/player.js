// Plays blendshape weights on faces, side by side, without a server: reads what `torchface.viz.reports` has written.
"use strict";

window.torchfacePlayer = (id, data) => {
  const root = document.getElementById(id);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const numbers = (Kind, text) => new Kind(bytes(text).buffer);
  const element = (tag, parent, className = "", text = "") => {
    const made = document.createElement(tag);
    made.className = className;
    made.textContent = text;
    parent.appendChild(made);
    return made;
  };

  // ---- what was written

  const of = numbers(Uint32Array, data.corner_vertex);
  const corners = numbers(Uint32Array, data.corner_faces);
  const faces = numbers(Uint32Array, data.faces);
  const uvs = data.uvs && numbers(Float32Array, data.uvs);
  const colors = numbers(Uint8Array, data.colors);
  const openness = numbers(Uint8Array, data.openness);
  const heat = numbers(Uint8Array, data.heat);
  const rigs = data.rigs.map((rig) => ({
    rest: numbers(Float32Array, rig.vertices),
    starts: numbers(Uint32Array, rig.starts),
    ids: numbers(Uint32Array, rig.ids),
    deltas: numbers(Int16Array, rig.deltas),
    scale: rig.scale,
  }));
  const takes = data.takes.map((take) => ({ ...take, weights: numbers(Uint16Array, take.weights) }));
  const markers = data.markers && {
    points: numbers(Int16Array, data.markers.points),
    heat: data.markers.heat && numbers(Uint8Array, data.markers.heat),
    count: data.markers.count,
    scale: data.markers.scale,
  };
  const count = rigs[0].rest.length / 3;
  const shapes = data.shapes.length;

  // ---- the page

  root.classList.add("player");
  element("style", root, "", `
    .player { margin: .8rem 0 }
    .player .bar, .player .line { display: flex; flex-wrap: wrap; align-items: center; gap: .4rem 1.2rem; font-size: .9rem }
    .player button { font: inherit; padding: .1rem .6rem; margin-left: .25rem; border: 1px solid #bbb; border-radius: 4px;
      background: #fff; cursor: pointer }
    .player button.on { background: #1f5fa8; border-color: #1f5fa8; color: #fff }
    .player .play { width: 2.6rem; margin: 0 }
    .player .scale i { display: inline-block; width: 7rem; height: .8rem; vertical-align: -.1rem; border-radius: 2px }
    .player .stage { position: relative; aspect-ratio: ${4 * data.panels.length} / 5; max-height: 80vh; width: 100%;
      cursor: grab; touch-action: none; margin: .1rem 0 .4rem }
    .player .stage canvas { position: absolute; width: 100%; height: 100% }
    .player .titles { display: flex; margin-top: .6rem }
    .player .titles span { flex: 1; text-align: center; font-weight: 600 }
    .player .slider { flex: 1 1 12rem; accent-color: #1f5fa8 } .player .clock { font-variant-numeric: tabular-nums;
      min-width: 10rem } .player .hint { color: #888; font-size: .8rem }
    .player .curves { width: 100%; margin-top: .6rem; cursor: pointer }`);
  const bar = element("div", root, "bar");
  const titles = element("div", root, "titles");
  const stage = element("div", root, "stage");
  const canvas = element("canvas", stage);
  data.panels.forEach((panel) => element("span", titles, "", panel.title));
  const line = element("div", root, "line");
  const play = element("button", line, "play", "❚❚");
  play.title = "play or pause (space)";
  const slider = element("input", line, "slider");
  Object.assign(slider, { type: "range", min: 0, max: data.frames - 1, value: 0 });
  slider.setAttribute("aria-label", "frame");
  const clock = element("span", line, "clock");
  const plot = data.curves.length ? element("canvas", root, "curves") : null;

  const state = { frame: data.start, playing: true, chosen: data.chosen, yaw: 0, pitch: 0, zoom: 1, speed: 1 };
  const choice = (label, options, current, change) => {
    const group = element("span", bar, "choice", label);
    const buttons = options.map(([name, value]) => {
      const button = element("button", group, value === current ? "on" : "", name);
      button.onclick = () => {
        buttons.forEach((other) => other.classList.toggle("on", other === button));
        change(value);
        show();
      };
      return button;
    });
  };
  if (data.choices.length > 1)
    choice("solved ", data.choices.map((take) => [takes[take].title, take]), state.chosen, (take) => {
      state.chosen = take;
      drawnCurves = null;
    });
  choice("speed ", [["1×", 1], ["½×", 0.5], ["¼×", 0.25]], 1, (speed) => (state.speed = speed));
  if (data.panels.some((panel) => panel.error)) legend(data.error_maximum, "distance, mm");
  if (markers && markers.heat) legend(data.markers.maximum, "marker error, mm");

  function legend(maximum, label) {
    const scale = element("span", bar, "scale", "0 ");
    const strip = element("i", scale);
    const stops = [0, 0.25, 0.5, 0.75, 1].map((share) => {
      const at = 3 * Math.round(255 * share);
      return `rgb(${heat[at]},${heat[at + 1]},${heat[at + 2]})`;
    });
    strip.style.background = `linear-gradient(90deg,${stops.join(",")})`;
    scale.append(` ${maximum} ${label}`);
  }

  // ---- moved faces

  const positions = rigs.map(() => new Float32Array(3 * count));

  function move(take, frame, out) {
    const rig = rigs[takes[take].rig];
    const weights = takes[take].weights;
    out.set(rig.rest);
    for (let shape = 0; shape < shapes; shape++) {
      const weight = (weights[frame * shapes + shape] / 65535) * rig.scale;
      if (weight === 0) continue;
      for (let k = rig.starts[shape]; k < rig.starts[shape + 1]; k++) {
        const vertex = 3 * rig.ids[k];
        out[vertex] += weight * rig.deltas[3 * k];
        out[vertex + 1] += weight * rig.deltas[3 * k + 1];
        out[vertex + 2] += weight * rig.deltas[3 * k + 2];
      }
    }
  }

  function normalsOf(points, out) {
    out.fill(0);
    for (let f = 0; f < faces.length; f += 3) {
      const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
      const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1], uz = points[b + 2] - points[a + 2];
      const vx = points[c] - points[a], vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      // Written out: a loop over the corners would make an array a triangle.
      out[a] += x; out[a + 1] += y; out[a + 2] += z;
      out[b] += x; out[b + 1] += y; out[b + 2] += z;
      out[c] += x; out[c + 1] += y; out[c + 2] += z;
    }
  }

  // ---- drawing with WebGL

  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    root.textContent = "This browser shows no WebGL; the pictures below show the same.";
    return;
  }
  const program = (vertex, fragment) => {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return made;
  };
  const skin = program(
    `uniform mat3 turn; uniform vec3 centre; uniform vec2 scale;
     uniform float distance;
     in vec3 position, normal; in vec2 uv; in vec4 color; in float open;
     out vec3 n; out vec2 st; out vec4 tint; out float free;
     void main() {
       vec3 p = turn * (position - centre);
       n = turn * normal; st = uv; tint = color; free = open;
       float w = 1.0 - p.z / distance;
       gl_Position = vec4(p.xy * scale, -p.z / 1000.0 * w, w);
     }`,
    // The lights of clay_shading.Lighting, in linear light as there: key, fill and rim, fixed to the camera.
    `uniform sampler2D image; uniform float textured;
     in vec3 n; in vec2 st; in vec4 tint; in float free; out vec4 pixel;
     void main() {
       vec3 normal = normalize(n);
       if (!gl_FrontFacing) normal = -normal;
       vec3 albedo = tint.a > 0.5 || textured < 0.5 ? tint.rgb : texture(image, st).rgb;
       float light = 0.18 * free, gloss = 0.0;
       vec3 ways[3] = vec3[3](vec3(-0.55, 0.60, 0.60), vec3(0.80, 0.10, 0.50), vec3(0.30, 0.60, -0.75));
       float strengths[3] = float[3](0.85, 0.12, 0.20);
       for (int i = 0; i < 3; i++) {
         vec3 way = normalize(ways[i]);
         light += strengths[i] * max((dot(normal, way) + 0.15) / 1.15, 0.0) * mix(0.35, 1.0, free);
         gloss += strengths[i] * pow(max(dot(normal, normalize(way + vec3(0, 0, 1))), 0.0), 30.0);
       }
       pixel = vec4(pow(pow(albedo, vec3(2.2)) * light + 0.05 * gloss * free, vec3(1.0 / 2.2)), 1.0);
     }`);
  const dots = program(
    `uniform mat3 turn; uniform vec3 centre; uniform vec2 scale; uniform float size, distance;
     in vec3 position; in vec4 color; out vec4 tint;
     void main() {
       vec3 p = turn * (position - centre); tint = color;
       float w = 1.0 - p.z / distance;
       gl_Position = vec4(p.xy * scale, -(p.z + 3.0) / 1000.0 * w, w);
       gl_PointSize = size;
     }`,
    `in vec4 tint; out vec4 pixel;
     void main() {
       float r = length(gl_PointCoord - 0.5);
       if (r > 0.5) discard;
       pixel = vec4(mix(tint.rgb, vec3(0.1), step(0.38, r)), 1.0);
     }`);
  const buffer = () => gl.createBuffer();
  const bind = (shader, name, at, size, kind, values, fixed, normalized = false) => {
    const location = gl.getAttribLocation(shader, name);
    if (location < 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, at);
    if (values) gl.bufferData(gl.ARRAY_BUFFER, values, fixed ? gl.STATIC_DRAW : gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, kind, normalized, 0, 0);
  };
  const buffers = { position: buffer(), normal: buffer(), uv: buffer(), color: buffer(), open: buffer(), index: buffer() };
  const cornerPositions = new Float32Array(3 * of.length), cornerNormals = new Float32Array(3 * of.length);
  const cornerOpen = Uint8Array.from(of, (vertex) => openness[vertex]);
  const plain = new Uint8Array(4 * of.length), painted = new Uint8Array(4 * of.length);
  of.forEach((vertex, i) => plain.set(colors.subarray(3 * vertex, 3 * vertex + 3), 4 * i));
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.index);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  bind(skin, "uv", buffers.uv, 2, gl.FLOAT, uvs || new Float32Array(2 * of.length), true);
  bind(skin, "open", buffers.open, 1, gl.UNSIGNED_BYTE, cornerOpen, true, true);

  let textured = 0;
  if (data.texture) {
    const picture = new Image();
    picture.onload = () => {
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
      gl.generateMipmap(gl.TEXTURE_2D);
      textured = 1;
      show();
    };
    picture.src = data.texture;
  }

  function turned(yaw, pitch) {
    const c = Math.cos(yaw), s = Math.sin(yaw), d = Math.cos(pitch), t = Math.sin(pitch);
    // Columns of a rotation about y, then about x.
    return new Float32Array([c, t * s, d * s, 0, d, -t, -s, t * c, d * c]);
  }

  function drawFace(panel, x, width, height) {
    const take = panel.take === null ? state.chosen : panel.take;
    const points = positions[0];
    move(take, state.frame, points);
    const normals = (drawFace.normals ||= new Float32Array(3 * count));
    normalsOf(points, normals);
    for (let i = 0; i < of.length; i++)
      for (let c = 0; c < 3; c++) {
        cornerPositions[3 * i + c] = points[3 * of[i] + c];
        cornerNormals[3 * i + c] = normals[3 * of[i] + c];
      }
    let tints = plain;
    if (panel.error) {
      const truth = (drawFace.truth ||= new Float32Array(3 * count));
      move(0, state.frame, truth);
      for (let i = 0; i < of.length; i++) {
        const v = 3 * of[i];
        const off = Math.hypot(points[v] - truth[v], points[v + 1] - truth[v + 1], points[v + 2] - truth[v + 2]);
        const at = 3 * Math.min(255, Math.round((255 * off) / data.error_maximum));
        painted[4 * i] = heat[at];
        painted[4 * i + 1] = heat[at + 1];
        painted[4 * i + 2] = heat[at + 2];
        painted[4 * i + 3] = 255;
      }
      tints = painted;
    }
    gl.viewport(x, 0, width, height);
    gl.scissor(x, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const turn = turned(state.yaw - (panel.yaw * Math.PI) / 180, state.pitch);
    const scale = (2 * state.zoom) / data.span;
    const uniforms = (shader) => {
      gl.useProgram(shader);
      gl.uniformMatrix3fv(gl.getUniformLocation(shader, "turn"), false, turn);
      gl.uniform3fv(gl.getUniformLocation(shader, "centre"), data.centre);
      gl.uniform2f(gl.getUniformLocation(shader, "scale"), (scale * height) / width, scale);
      // A portrait's lens: 18 degrees high, as in torchface.geometry.camera.look_at.
      gl.uniform1f(gl.getUniformLocation(shader, "distance"), data.span / 2 / Math.tan(Math.PI / 20));
    };
    uniforms(skin);
    gl.uniform1f(gl.getUniformLocation(skin, "textured"), textured);
    bind(skin, "position", buffers.position, 3, gl.FLOAT, cornerPositions);
    bind(skin, "normal", buffers.normal, 3, gl.FLOAT, cornerNormals);
    bind(skin, "color", buffers.color, 4, gl.UNSIGNED_BYTE, tints, false, true);
    bind(skin, "uv", buffers.uv, 2, gl.FLOAT);
    bind(skin, "open", buffers.open, 1, gl.UNSIGNED_BYTE, null, true, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.index);
    gl.drawElements(gl.TRIANGLES, corners.length, gl.UNSIGNED_INT, 0);
    if (panel.markers && markers) drawMarkers(uniforms, height);
  }

  const markerBuffers = { position: buffer(), color: buffer() };
  function drawMarkers(uniforms, height) {
    const points = [], tints = [];
    for (let m = 0; m < markers.count; m++) {
      const at = state.frame * markers.count + m;
      if (markers.points[3 * at] === -32768) continue;
      for (let c = 0; c < 3; c++) points.push(markers.points[3 * at + c] * markers.scale);
      const color = markers.heat ? heat.subarray(3 * markers.heat[at], 3 * markers.heat[at] + 3) : [245, 245, 245];
      tints.push(color[0], color[1], color[2], 255);
    }
    uniforms(dots);
    gl.uniform1f(gl.getUniformLocation(dots, "size"), Math.max(5, height / 75) * Math.sqrt(state.zoom));
    bind(dots, "position", markerBuffers.position, 3, gl.FLOAT, new Float32Array(points));
    bind(dots, "color", markerBuffers.color, 4, gl.UNSIGNED_BYTE, new Uint8Array(tints), false, true);
    gl.drawArrays(gl.POINTS, 0, tints.length / 4);
  }

  // ---- curves with the frame that is shown

  let drawnCurves = null;
  function showCurves() {
    if (!plot) return;
    const ratio = window.devicePixelRatio || 1;
    const columns = 2, rows = Math.ceil(data.curves.length / columns);
    const width = root.clientWidth, height = rows * 84;
    const place = (i) => {
      const w = width / columns;
      return { x: (i % columns) * w + 4, y: Math.floor(i / columns) * 84 + 20, w: w - 16, h: 56 };
    };
    if (!drawnCurves || drawnCurves.width !== Math.round(width * ratio)) {
      plot.style.height = `${height}px`;
      drawnCurves = document.createElement("canvas");
      Object.assign(drawnCurves, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
      Object.assign(plot, { width: drawnCurves.width, height: drawnCurves.height });
      const pen = drawnCurves.getContext("2d");
      pen.scale(ratio, ratio);
      pen.font = "12px system-ui, sans-serif";
      data.curves.forEach((shape, i) => {
        const { x, y, w, h } = place(i);
        pen.fillStyle = "#333";
        pen.fillText(data.shapes[shape], x, y - 5);
        pen.strokeStyle = "#ddd";
        pen.lineWidth = 1;
        pen.strokeRect(x, y, w, h);
        const shown = data.reference === null ? [state.chosen] : [data.reference, state.chosen];
        shown.forEach((take) => {
          pen.beginPath();
          for (let frame = 0; frame < data.frames; frame++) {
            const value = takes[take].weights[frame * shapes + shape] / 65535;
            pen.lineTo(x + (w * frame) / Math.max(1, data.frames - 1), y + h - h * value);
          }
          const reference = take === data.reference;
          pen.strokeStyle = reference ? "#d9822b" : "#1f5fa8";
          pen.lineWidth = reference ? 2.6 : 1.1;
          pen.stroke();
        });
      });
      if (data.reference !== null && data.curves.length > 1) {
        const { x, y, w } = place(1);
        pen.textAlign = "right";
        pen.fillStyle = "#d9822b";
        pen.fillText("true", x + w - 60, y - 5);
        pen.fillStyle = "#1f5fa8";
        pen.fillText("solved", x + w, y - 5);
      }
    }
    const pen = plot.getContext("2d");
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, plot.width, plot.height);
    pen.drawImage(drawnCurves, 0, 0);
    pen.scale(ratio, ratio);
    pen.strokeStyle = "#000";
    data.curves.forEach((shape, i) => {
      const { x, y, w, h } = place(i);
      const at = x + (w * state.frame) / Math.max(1, data.frames - 1);
      pen.beginPath();
      pen.moveTo(at, y);
      pen.lineTo(at, y + h);
      pen.stroke();
    });
    plot.onclick = (event) => {
      const w = width / columns, inside = (event.offsetX % w) - 4;
      seek(Math.round((Math.min(Math.max(inside / (w - 16), 0), 1)) * (data.frames - 1)));
    };
  }

  // ---- time and hands

  function show() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(stage.clientWidth * ratio), height = Math.round(stage.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    gl.clearColor(1, 1, 1, 1);
    const each = Math.floor(width / data.panels.length);
    data.panels.forEach((panel, i) => drawFace(panel, i * each, each, height));
    slider.value = state.frame;
    clock.textContent = `${(state.frame / data.fps).toFixed(2)} s, frame ${state.frame * data.step}`;
    showCurves();
  }
  function seek(frame) {
    state.frame = Math.min(Math.max(frame, 0), data.frames - 1);
    began = null;
    show();
  }
  let began = null;
  function tick(now) {
    if (state.playing) {
      if (began === null) began = now - (1000 * state.frame) / data.fps / state.speed;
      const frame = Math.floor((((now - began) / 1000) * data.fps * state.speed) % data.frames);
      if (frame !== state.frame) {
        state.frame = frame;
        show();
      }
    }
    requestAnimationFrame(tick);
  }
  function toggle(playing) {
    state.playing = playing;
    began = null;
    play.textContent = playing ? "❚❚" : "▶";
  }
  play.onclick = () => toggle(!state.playing);
  slider.oninput = () => {
    toggle(false);
    seek(Number(slider.value));
  };
  bar.addEventListener("click", () => (began = null));
  stage.onpointerdown = (event) => stage.setPointerCapture(event.pointerId);
  stage.onpointermove = (event) => {
    if (!event.buttons) return;
    state.yaw += event.movementX / 150;
    state.pitch = Math.min(1.2, Math.max(-1.2, state.pitch + event.movementY / 150));
    show();
  };
  stage.ondblclick = () => {
    Object.assign(state, { yaw: 0, pitch: 0, zoom: 1 });
    show();
  };
  stage.onwheel = (event) => {
    if (!event.ctrlKey && !event.altKey) return;
    event.preventDefault();
    state.zoom = Math.min(6, Math.max(0.5, state.zoom * Math.exp(-event.deltaY / 400)));
    show();
  };
  element("span", line, "hint", "drag to turn, Ctrl and wheel to zoom, double click to return");
  window.addEventListener("resize", show);
  show();
  requestAnimationFrame(tick);
  root.player = { seek, toggle, state };
};
