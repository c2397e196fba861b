// The 3D scene of a report: WebGL over the drawing. The drawing is what paper, and a browser without WebGL, show.
"use strict";
(() => {
  const box = document.querySelector(".turned"), canvas = box.querySelector("canvas");
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) return;
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const points = new Float32Array(bytes(data.points).buffer), colours = bytes(data.colours);
  const triangles = data.wide ? new Uint32Array(bytes(data.triangles).buffer) : new Uint16Array(bytes(data.triangles).buffer);
  const segments = new Float32Array(bytes(data.segments).buffer), strokes = bytes(data.strokes);

  const shader = (kind, text) => {
    const made = gl.createShader(kind);
    gl.shaderSource(made, "#version 300 es\nprecision highp float;\n" + text);
    gl.compileShader(made);
    return made;
  };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, `in vec3 place; in vec3 colour; uniform mat4 view; out vec3 tint; out vec3 at;
    void main() { tint = colour; at = place; gl_Position = view * vec4(place, 1.0); }`));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, `in vec3 tint; in vec3 at; uniform bool lit; out vec4 seen;
    void main() { float light = 1.0;
      if (lit) { vec3 n = normalize(cross(dFdx(at), dFdy(at))); light = 0.5 + 0.5 * abs(dot(n, normalize(vec3(0.35, -0.75, 0.9)))); }
      seen = vec4(tint * light, 1.0); }`));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return;
  gl.useProgram(program);
  const put = (name, values, size, normalised) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    const where = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, size, normalised ? gl.UNSIGNED_BYTE : gl.FLOAT, normalised, 0, 0);
  };
  const body = (places, tints) => {
    const made = gl.createVertexArray();
    gl.bindVertexArray(made);
    put("place", places, 3, false);
    put("colour", tints, 3, true);
    return made;
  };
  const surfaces = body(points, colours);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
  const lines = body(segments, strokes);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(1, 1, 1, 1);

  const [tx, ty, tz] = data.towards, away = data.eye.map((v, k) => v - data.towards[k]);
  let reach = 0;
  for (const list of [points, segments])
    for (let i = 0; i < list.length; i += 3) reach = Math.max(reach, Math.hypot(list[i] - tx, list[i + 1] - ty, list[i + 2] - tz));
  let far = 2.6 * reach, around = Math.atan2(away[1], away[0]), up = Math.atan2(away[2], Math.hypot(away[0], away[1]));

  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const view = () => {  // columns, as WebGL wants them
    const back = [Math.cos(up) * Math.cos(around), Math.cos(up) * Math.sin(around), Math.sin(up)];
    const right = [-Math.sin(around), Math.cos(around), 0], top = cross(back, right);
    const eye = [tx + far * back[0], ty + far * back[1], tz + far * back[2]];
    const near = Math.max(1, far - 1.2 * reach), end = far + 1.2 * reach, f = 2.3;  // all is in sight at first
    const x = right.map((v) => v * f * canvas.height / canvas.width), y = top.map((v) => v * f);
    const a = (end + near) / (near - end), b = 2 * end * near / (near - end), z = -dot(back, eye);
    return [
      x[0], y[0], a * back[0], -back[0], x[1], y[1], a * back[1], -back[1], x[2], y[2], a * back[2], -back[2],
      -dot(x, eye), -dot(y, eye), a * z + b, -z,
    ];
  };
  const labels = data.labels.map(([text, at]) => {
    const span = document.createElement("span");
    span.textContent = text;
    box.append(span);
    return [span, at];
  });
  let asked = false;
  const draw = () => {
    asked = false;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(box.clientWidth * ratio);
    canvas.height = Math.round(box.clientHeight * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const m = view();
    gl.uniformMatrix4fv(gl.getUniformLocation(program, "view"), false, m);
    gl.uniform1i(gl.getUniformLocation(program, "lit"), 1);
    gl.bindVertexArray(surfaces);
    gl.drawElements(gl.TRIANGLES, triangles.length, data.wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, 0);
    gl.uniform1i(gl.getUniformLocation(program, "lit"), 0);
    gl.bindVertexArray(lines);
    gl.drawArrays(gl.LINES, 0, segments.length / 3);
    for (const [span, p] of labels) {
      const w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
      const u = (m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w, v = (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w;
      span.hidden = w <= 0 || Math.abs(u) > 1 || Math.abs(v) > 1;
      span.style.left = `${50 + 50 * u}%`;
      span.style.top = `${50 - 50 * v}%`;
    }
  };
  const soon = () => { if (!asked) { asked = true; requestAnimationFrame(draw); } };
  const turn = (across, down) => { around -= across; up = Math.min(1.55, Math.max(-1.55, up + down)); soon(); };
  const nearer = (times) => { far = Math.min(8 * reach, Math.max(0.3 * reach, far * times)); soon(); };
  const held = new Map();
  box.addEventListener("pointerdown", (e) => { held.set(e.pointerId, [e.clientX, e.clientY]); box.setPointerCapture(e.pointerId); });
  for (const end of ["pointerup", "pointercancel"]) box.addEventListener(end, (e) => held.delete(e.pointerId));
  box.addEventListener("pointermove", (e) => {
    const before = held.get(e.pointerId);
    if (!before) return;
    const others = [...held].filter(([id]) => id !== e.pointerId).map(([, at]) => at);
    held.set(e.pointerId, [e.clientX, e.clientY]);
    if (others.length) {  // two fingers: their distance
      const apart = (at) => Math.hypot(at[0] - others[0][0], at[1] - others[0][1]);
      nearer(apart(before) / Math.max(1, apart([e.clientX, e.clientY])));
    } else turn(0.008 * (e.clientX - before[0]), 0.008 * (e.clientY - before[1]));
  });
  box.addEventListener("wheel", (e) => { e.preventDefault(); nearer(Math.exp(0.001 * e.deltaY)); }, { passive: false });
  box.addEventListener("keydown", (e) => {
    const does = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (does) turn(...does);
    else if (e.key === "+") nearer(0.85);
    else if (e.key === "-") nearer(1.18);
    else return;
    e.preventDefault();
  });
  box.hidden = false;
  addEventListener("DOMContentLoaded", () => { document.querySelector(".turned-hint").hidden = false; });
  new ResizeObserver(soon).observe(box);
})();
