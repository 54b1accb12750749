// A timeline of expressions, played by the clock: weights of the blend shapes move, and with them
// blood, wrinkles and strain.
Object.assign(V.defaults, {timeline_s: 0});
V.TIMELINE = [[0, "neutral"], [1, "happiness"], [2, "happiness"], [3, "surprise"], [4.2, "anger"],
  [5.4, "anger"], [6.4, "neutral"], [8.4, "exercise"], [10, "neutral"]];
V.timelineKeys = () => V.TIMELINE.filter(([, name]) => name in (V.scene.presets ?? {}));
V.timelineEnd = () => V.timelineKeys().at(-1)[0];

// Weights at a time, eased between the expressions before and after it.
V.timelineWeights = time => {
  const keys = V.timelineKeys();
  const next = Math.max(keys.findIndex(([at]) => at >= time), 1);
  const [[from, first], [to, second]] = [keys[next - 1], keys[next]];
  const share = V.limit((time - from) / (to - from), 0, 1);
  const eased = share * share * (3 - 2 * share);
  const [a, b] = [first, second].map(name => V.scene.presets[name].weights ?? {});
  return Object.fromEntries(V.weightNames().map(name =>
    [name, (1 - eased) * (a[name] ?? 0) + eased * (b[name] ?? 0)]));
};
V.seek = time => V.set({timeline_s: time, weights: V.timelineWeights(time)});

// Play from where the timeline is; frames that the device cannot draw in time are omitted.
V.play = () => {
  const begun = performance.now() - 1e3 * (V.params.timeline_s % V.timelineEnd());
  const turn = V.playing = {};  // a later start ends this one
  const step = now => {
    if (V.playing !== turn) return;
    V.seek(((now - begun) / 1e3) % V.timelineEnd());
    // the pause lets slow devices answer buttons
    setTimeout(() => requestAnimationFrame(step), V.software() ? 50 : 0);
  };
  requestAnimationFrame(step);
};

V.buildTimeline = box => {
  const button = V.element("button", {type: "button", id: "play", "aria-pressed": "false"}, "Play");
  const slider = V.buildControl({kind: "range", path: ["timeline_s"], min: 0, max: V.timelineEnd(), label: "Timeline",
    change: V.timelineChange, show: time => `${time.toFixed(1)} s`,
    help: "Happiness, surprise, anger, exercise: wrinkles and blood follow."}, "timeline");
  const show = () => {
    button.textContent = V.playing ? "Pause" : "Play";
    button.setAttribute("aria-pressed", String(Boolean(V.playing)));
  };
  button.onclick = () => {
    if (V.playing) {
      V.playing = null;
      V.set({});
    } else V.play();
    show();
    V.announce(V.playing ? "Timeline plays" : "Timeline paused");
  };
  box.append(V.element("div", {className: "buttons"}, button), slider.box);
  return p => {
    slider.update(p);
    show();
  };
};
V.timelineChange = time => {
  V.playing = null;
  return {timeline_s: time, weights: V.timelineWeights(time)};
};
