// Comparison of two sets of parameters: a divider, both in turn, or their difference.
Object.assign(V.defaults, {difference_gain: 0});
V.FLIP_MS = 500;

V.stopFlip = () => {
  clearInterval(V.flipping);
  V.flipping = 0;
};
V.compareWith = (change, words) => {
  V.stopFlip();
  V.set({compare: V.merged(V.faceOf(V.params), change), split: 0.5, difference_gain: 0});
  V.announce(words);
};

V.buildComparison = box => {
  const button = (text, act) => {
    const made = V.element("button", {type: "button"}, text);
    made.onclick = act;
    return made;
  };
  const keep = button("Store as B", () => V.compareWith({},
    "B keeps the current settings; controls change A, left of the divider."));
  const neutral = button("Neutral as B", () => V.compareWith(
    {weights: Object.fromEntries(V.weightNames().map(name => [name, 0]))}, "B is the neutral expression."));
  const scattering = button("Scattering off as B", () => V.compareWith({scattering: false},
    "B is without subsurface scattering."));
  const swap = button("Swap A and B", () => {
    const held = V.params.compare;
    V.set({...held, compare: V.faceOf(V.params)});
    V.announce("A and B are swapped.");
  });
  const flip = button("Flip", () => {
    if (V.flipping) {
      V.stopFlip();
      V.set({split: 0.5});
    } else {
      V.flipping = setInterval(() => V.set({split: V.params.split < 0.5 ? 1 : 0}), V.FLIP_MS);
      V.set({split: 1, difference_gain: 0});
    }
    V.announce(V.flipping ? "A and B are shown in turn." : "A and B are side by side.");
  });
  const end = button("End", () => {
    V.stopFlip();
    V.set({compare: null, difference_gain: 0});
    V.announce("Comparison ended.");
    keep.focus();
  });
  const slider = V.buildControl({kind: "range", path: ["split"], min: 0, max: 1, zero: 0, label: "Divider",
    show: V.percent}, "split");
  slider.input.addEventListener("input", V.stopFlip);
  const gain = V.buildControl({kind: "range", path: ["difference_gain"], min: 0, max: 32, step: 1, label: "Difference",
    show: value => value ? `× ${value}` : "off", help: "A − B times this gain, around gray."}, "difference");
  gain.input.addEventListener("input", V.stopFlip);
  box.append(V.element("p", {className: "label"}, "Compare A with B"),
    V.element("div", {className: "buttons"}, keep,
      ...("weights" in V.params ? [neutral, scattering] : []), swap, flip, end), slider.box, gain.box,
    V.element("p", {className: "help"}, "Controls change A, left of the divider. B is fixed."));
  return p => {
    if (!p.compare) V.stopFlip();
    slider.update(p);
    gain.update(p);
    flip.setAttribute("aria-pressed", String(Boolean(V.flipping)));
    const whole = p.difference_gain > 0;
    slider.input.disabled = whole;
    for (const one of [slider.box, gain.box, swap, flip, end]) one.hidden = !p.compare;
    const port = document.getElementById("port");
    const [a, b] = port.querySelectorAll(".badge");
    a.hidden = !p.compare || whole || p.split === 0;
    b.hidden = !p.compare || whole || p.split === 1;
    V.placeDivider(p);
  };
};
