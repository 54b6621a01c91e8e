// Draws the mesh of a run: drag turns it, the wheel or two fingers zoom, dragging with Shift moves it.
"use strict";
(function () {
  const canvas = document.getElementById("mesh");
  const gl = canvas.getContext("webgl2", { antialias: true });
  const scene = JSON.parse(document.getElementById("scene").textContent);
  if (!gl) {
    document.getElementById("mesh-note").textContent = "This browser offers no WebGL 2: the picture stands still.";
    return;
  }
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
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
  // Two lamps fixed to the eye; the inside of an open surface is lit like its outside, but tinted.
  const surface = program(
    `in vec3 place; in vec3 normal; in vec3 colour; uniform mat4 view, projection;
     out vec3 towards; out vec3 paint; out vec3 at;
     void main() { vec4 seen = view * vec4(place, 1.0); at = seen.xyz; towards = mat3(view) * normal; paint = colour;
                   gl_Position = projection * seen; }`,
    `in vec3 towards; in vec3 paint; in vec3 at; uniform float plain; out vec4 pixel;
     void main() { vec3 n = normalize(towards); bool inside = dot(n, at) > 0.0; if (inside) n = -n;
                   float light = 0.30 + 0.55 * max(dot(n, normalize(vec3(-0.4, 0.6, 0.8))), 0.0)
                               + 0.25 * max(dot(n, normalize(vec3(0.7, -0.1, 0.6))), 0.0);
                   vec3 base = mix(paint, vec3(0.72, 0.74, 0.77), plain);
                   if (inside) base = mix(base, vec3(0.75, 0.35, 0.30), 0.45);
                   pixel = vec4(base * light, 1.0); }`);
  const wires = program(
    `in vec3 place; uniform mat4 view, projection; void main() { gl_Position = projection * view * vec4(place, 1.0); }`,
    `out vec4 pixel; void main() { pixel = vec4(0.35, 0.45, 0.60, 1.0); }`);
  const attribute = (made, name, data, type, normalized) => {
    const where = gl.getAttribLocation(made, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, 3, type, normalized, 0, 0);
  };
  const body = gl.createVertexArray();
  gl.bindVertexArray(body);
  attribute(surface, "place", bytes(scene.positions), gl.SHORT, true);
  attribute(surface, "normal", bytes(scene.normals), gl.BYTE, true);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, bytes(scene.triangles), gl.STATIC_DRAW);
  const frame = gl.createVertexArray();
  gl.bindVertexArray(frame);
  const strokes = bytes(scene.lines);
  attribute(wires, "place", strokes, gl.FLOAT, false);

  // Column by column. `turn` takes object axes (y down, z forward in the first image) to the eye's (y up, z back).
  let turn, distance, shift, plain;
  const multiplied = (a, b) => a.map((_, k) => [0, 1, 2].reduce((s, j) => s + a[3 * j + (k % 3)] * b[3 * ((k / 3) | 0) + j], 0));
  const about = (axis, angle) => {
    const c = Math.cos(angle), s = Math.sin(angle);
    return axis === "x" ? [1, 0, 0, 0, c, s, 0, -s, c] : [c, 0, -s, 0, 1, 0, s, 0, c];
  };
  const home = () => { turn = multiplied(about("x", 0.45), multiplied(about("y", 0.6), scene.upright)); distance = 3.4; shift = [0, 0]; };
  // What the surface is painted with: colour as seen, how sure each vertex is, or plain grey.
  const chooser = document.getElementById("paint");
  const repaint = () => {
    const chosen = scene[chooser.value];
    gl.bindVertexArray(body);
    if (chosen) attribute(surface, "colour", bytes(chosen), gl.UNSIGNED_BYTE, true);
    plain = chosen ? 0 : 1;
    document.getElementById("scale").hidden = chooser.value !== "certainty";
  };
  const checked = (name) => { const box = document.getElementById(name); return box !== null && box.checked; };
  const draw = () => {
    const scale = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * scale);
    canvas.height = Math.round(canvas.clientHeight * scale);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.965, 0.97, 0.975, 1.0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const near = Math.max(0.05, distance - 40), far = distance + 40, zoom = 2.6, wide = canvas.width / canvas.height;
    const projection = [zoom / wide, 0, 0, 0, 0, zoom, 0, 0, 0, 0, -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0];
    const view = [...turn.slice(0, 3), 0, ...turn.slice(3, 6), 0, ...turn.slice(6, 9), 0, shift[0], shift[1], -distance, 1];
    for (const [made, array] of [[surface, body], [wires, frame]]) {
      gl.useProgram(made);
      gl.bindVertexArray(array);
      gl.uniformMatrix4fv(gl.getUniformLocation(made, "view"), false, view);
      gl.uniformMatrix4fv(gl.getUniformLocation(made, "projection"), false, projection);
      if (made === surface) {
        gl.uniform1f(gl.getUniformLocation(made, "plain"), plain);
        gl.drawElements(gl.TRIANGLES, scene.count, gl.UNSIGNED_INT, 0);
      } else if (checked("cameras")) gl.drawArrays(gl.LINES, 0, strokes.length / 12);
    }
  };
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const [right, down] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const others = [...fingers.values()].filter((finger) => finger.pointerId !== event.pointerId);
    if (others.length) {
      const apart = (finger) => Math.hypot(finger.clientX - others[0].clientX, finger.clientY - others[0].clientY);
      distance *= apart(before) / Math.max(apart(event), 1);
    } else if (event.shiftKey || event.buttons === 2) {
      const step = distance / (1.3 * canvas.clientHeight);
      shift = [shift[0] + right * step, shift[1] - down * step];
    } else turn = multiplied(about("x", 0.008 * down), multiplied(about("y", 0.008 * right), turn));
    fingers.set(event.pointerId, event);
    draw();
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); distance *= Math.exp(0.001 * event.deltaY); draw(); }, { passive: false });
  canvas.addEventListener("dblclick", () => { home(); draw(); });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  const reach = new Float32Array(strokes.buffer).reduce((most, number) => Math.max(most, Math.abs(number)), 1);
  document.getElementById("cameras").addEventListener("change", () => {
    distance = checked("cameras") ? Math.max(distance, 2.9 * reach) : 3.4;
    draw();
  });
  chooser.addEventListener("change", () => { repaint(); draw(); });
  window.addEventListener("resize", draw);
  home();
  repaint();
  draw();
  canvas.dataset.drawn = String(scene.count / 3);
})();
