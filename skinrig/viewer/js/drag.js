// Input on the canvas: pointers and keys rotate the camera, move the light or probe a pixel.
Object.assign(V.defaults, {resolution: 0});
V.tool = "orbit";

V.TOOLS = {
  orbit: "Drag or arrow keys: rotate. Wheel, pinch, + and −: zoom. Shift and drag: pan.",
  light: "Drag or arrow keys: move the light around the face.",
  probe: "Click, or arrow keys (Shift: ten pixels) and Enter: read volume fractions at a pixel.",
};

V.setTool = name => {
  V.tool = name;
  for (const button of document.querySelectorAll("[data-tool]")) {
    if (button.tagName === "BUTTON") button.setAttribute("aria-pressed", button.dataset.tool === name);
  }
  document.getElementById("port").dataset.tool = name;
  document.getElementById("view-help").textContent =
    `${V.TOOLS[name]} O camera, L light, P probe, R reset.`;
  if (name === "probe") V.showProbe();
  else V.hideProbe();
};

V.limit = (value, low, high) => Math.min(high, Math.max(low, value));
V.turned = degrees => ((degrees + 180) % 360 + 360) % 360 - 180;

V.orbit = (right, up) => V.set({
  camera_yaw_deg: V.turned(V.params.camera_yaw_deg - right),
  camera_pitch_deg: V.limit(V.params.camera_pitch_deg + up, -80, 80),
});
// By arrow keys: the camera goes where the arrow points.
V.turn = (right, up) => V.orbit(-right, up);
V.moveLight = (right, up) => V.set({
  light_azimuth_deg: V.turned(V.params.light_azimuth_deg + right),
  light_elevation_deg: V.limit(V.params.light_elevation_deg + up, -89, 89),
});
V.zoom = factor => V.set({
  camera_distance_mm: V.limit(V.params.camera_distance_mm * factor, 45, V.FARTHEST_MM),
});
// Move the camera's target parallel to the screen, by fractions of the canvas height.
V.pan = (right, up) => {
  const p = V.params;
  const height = 2 * p.camera_distance_mm * Math.tan(0.5 * p.camera_fov_deg * V.RAD);
  const x = V.direction(p.camera_yaw_deg + 90, 0);
  const y = V.direction(p.camera_yaw_deg, p.camera_pitch_deg + 90);
  V.set({camera_target_mm: p.camera_target_mm.map((t, i) =>
    V.limit(t - height * (right * x[i] + up * y[i]), -200, 200))});
};

V.speakPlace = () => {
  const p = V.params;
  V.announce(V.tool === "light"
    ? `Light ${Math.round(p.light_azimuth_deg)} degrees to the side, ${Math.round(p.light_elevation_deg)} up`
    : `Camera ${Math.round(p.camera_yaw_deg)} degrees to the side, ${Math.round(p.camera_pitch_deg)} up, ` +
      `${Math.round(p.camera_distance_mm)} millimeters away`);
};

// Resize the canvas to its container, within the cost limit of a frame. A size set by a script is
// kept until a resolution is chosen.
V.fitCanvas = () => {
  const port = document.getElementById("port");
  const [width, height] = [port.clientWidth, port.clientHeight];
  const {resolution} = V.params;
  const moving = V.playing && V.software();
  const last = V.fitted;
  if (!width || !height) return false;
  if (last && last.resolution === resolution && last.moving === moving && (last.width === width && last.height === height
    || V.canvas.width !== last.size[0] || V.canvas.height !== last.size[1])) return false;
  const most = resolution || (moving ? 256 : V.software() ? 448 : 1280);
  const dense = resolution ? Infinity : window.devicePixelRatio || 1;
  const scale = Math.min(dense, most / Math.max(width, height));
  const size = [width, height].map(side => Math.max(16, Math.round(side * scale)));
  V.fitted = {width, height, resolution, moving, size};
  if (V.canvas.width === size[0] && V.canvas.height === size[1]) return false;
  [V.canvas.width, V.canvas.height] = size;
  return true;
};

// Position of the canvas in its container; the aspect ratio is kept.
V.shown = () => {
  const box = document.getElementById("port").getBoundingClientRect();
  const scale = Math.min(box.width / V.canvas.width, box.height / V.canvas.height);
  const [width, height] = [V.canvas.width * scale, V.canvas.height * scale];
  return {left: 0.5 * (box.width - width), top: 0.5 * (box.height - height), width, height, scale, box};
};
V.pixelAt = event => {
  const {left, top, scale, box} = V.shown();
  return [event.clientX - box.left - left, event.clientY - box.top - top]
    .map((at, i) => V.limit(Math.floor(at / scale), 0, (i ? V.canvas.height : V.canvas.width) - 1));
};
V.placeDivider = p => {
  const divider = document.getElementById("divider");
  divider.hidden = !p.compare || p.difference_gain > 0 || p.split === 0 || p.split === 1;
  const {left, width} = V.shown();
  divider.style.left = `${left + p.split * width}px`;
};

V.buildHands = () => {
  const port = document.getElementById("port");
  const held = new Map();
  let apart = 0;
  const gap = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  port.addEventListener("pointerdown", event => {
    if (event.button > 0) return;
    port.setPointerCapture(event.pointerId);
    port.focus({preventScroll: true});
    held.set(event.pointerId, {x: event.clientX, y: event.clientY});
    port.dataset.held = "";
    if (held.size === 2) apart = gap();
    const {left, width, box} = V.shown();
    const divider = box.left + left + V.params.split * width;
    V.dividing = Boolean(V.params.compare) && Math.abs(event.clientX - divider) < 14;
    if (V.tool === "probe" && !V.dividing) V.readAt(...V.pixelAt(event));
  });
  port.addEventListener("pointermove", event => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const [right, down] = [event.clientX - last.x, event.clientY - last.y];
    held.set(event.pointerId, {x: event.clientX, y: event.clientY});
    if (held.size === 2) {
      const now = gap();
      if (now > 0 && apart > 0) V.zoom(apart / now);
      apart = now;
      return;
    }
    const {width, height, left, box} = V.shown();
    if (V.dividing) {
      V.set({split: V.limit((event.clientX - box.left - left) / width, 0, 1)});
    } else if (V.tool === "probe") {
      V.readAt(...V.pixelAt(event));
    } else if (V.tool === "light") {
      V.moveLight(180 * right / width, -180 * down / height);
    } else if (event.shiftKey) {
      V.pan(right / height, -down / height);
    } else {
      V.orbit(200 * right / width, 200 * down / height);
    }
  });
  const release = event => {
    if (!held.delete(event.pointerId)) return;
    if (!held.size) { delete port.dataset.held; V.dividing = false; if (V.tool !== "probe") V.speakPlace(); }
  };
  port.addEventListener("pointerup", release);
  port.addEventListener("pointercancel", release);
  port.addEventListener("wheel", event => {
    event.preventDefault();
    V.zoom(Math.exp(V.limit(event.deltaY, -200, 200) / 600));
  }, {passive: false});
  port.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrows = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]};
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const tools = {o: "orbit", l: "light", p: "probe"};
    if (arrows[key]) {
      const [x, y] = arrows[key];
      const step = event.shiftKey ? 15 : 5;
      if (V.tool === "probe") V.moveProbe(x * (event.shiftKey ? 10 : 1), -y * (event.shiftKey ? 10 : 1));
      else if (V.tool === "light") V.moveLight(step * x, step * y);
      else V.turn(step * x, step * y);
      if (V.tool !== "probe") V.speakPlace();
    } else if (key === "+" || key === "=") V.zoom(1 / 1.1);
    else if (key === "-") V.zoom(1.1);
    else if (key === "Enter" || key === " ") V.showProbe();
    else if (key === "r") V.reset();
    else if (tools[key]) { V.setTool(tools[key]); V.announce(V.TOOLS[tools[key]]); }
    else return;
    event.preventDefault();
  });
  for (const button of document.querySelectorAll("button[data-tool]")) {
    button.onclick = () => V.setTool(button.dataset.tool);
  }
  new ResizeObserver(() => {
    if (V.fitCanvas()) V.requestDraw();
    V.placeDivider(V.params);
    V.placeCross();
  }).observe(port);
};

V.start.push(() => {
  V.setTool("orbit");
  V.buildHands();
  V.fitCanvas();
  V.changed.push(() => { if (V.fitCanvas()) V.requestDraw(); });
});
