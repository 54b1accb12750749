// Opens an image of the report in full size, with a second image of its group and the values
// under the pointer or a point that arrow keys move. Values are read from the colors of the page's
// own images and color bars.
"use strict";
(() => {
  const MASKED_GRAY = Number(document.currentScript.dataset.maskedGray);
  const FLIP_MS = 500;
  const FOREIGN_COLOR = 400; // squared distance in 8-bit sRGB beyond which a color is not of the bar

  const IMAGES = 'img, a[href^="#image-"]';
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const FAST_STEP_PX = 10; // with the shift key

  const make = (tag, attributes = {}, ...children) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  };

  // 17 colors from low to high, as the style sheet draws them
  const readStops = (bar) =>
    [...getComputedStyle(bar).backgroundImage.matchAll(/rgb\((\d+), (\d+), (\d+)\)/g)].map((found) =>
      found.slice(1).map(Number),
    );

  // position of a color on a ramp, from 0 to 1, and its squared distance to the ramp
  const locate = (color, stops) => {
    let best = { distance: Infinity, at: 0 };
    for (let i = 0; i + 1 < stops.length; i++) {
      const step = stops[i + 1].map((end, k) => end - stops[i][k]);
      const length = step.reduce((sum, x) => sum + x * x, 0);
      const along = step.reduce((sum, x, k) => sum + x * (color[k] - stops[i][k]), 0);
      const t = Math.min(1, Math.max(0, along / length));
      const distance = step.reduce((sum, x, k) => sum + (color[k] - stops[i][k] - t * x) ** 2, 0);
      if (distance < best.distance) best = { distance, at: (i + t) / (stops.length - 1) };
    }
    return best;
  };

  const isMasked = (color) => color.every((value) => value === MASKED_GRAY);

  // what one figure shows: its title, its pixels, and how a color becomes a value; a link
  // replaces an image that is on the page already
  const describe = (part) => {
    const figure = part.closest("figure");
    const image = part.matches("a") ? document.querySelector(part.getAttribute("href")) : part;
    const scale = figure.querySelector(".scale .bar") || part.closest(".quantity")?.querySelector(".scale .bar");
    const texts = scale ? [...scale.parentElement.children].map((part) => part.textContent) : [];
    const [low, high, unit] = [Number.parseFloat(texts[0]), Number.parseFloat(texts[2]), texts[3] || ""];
    const stops = scale ? readStops(scale) : [];
    const canvas = make("canvas");
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    const read = (x, y) => {
      const color = [...context.getImageData(x, y, 1, 1).data].slice(0, 3);
      if (isMasked(color)) return "masked";
      if (/x, y, z as red, green, blue/.test(image.alt))
        return `x, y, z ≈ ${color.map((value) => (value / 127.5 - 1).toFixed(2)).join(", ")}`;
      if (stops.length < 2) return `red, green, blue ${color.join(", ")} of 255, sRGB`;
      const { at, distance } = locate(color, stops);
      if (distance > FOREIGN_COLOR) return "no value";
      const sign = at <= 0 ? "≤" : at >= 1 ? "≥" : "≈"; // the ends show all values beyond
      return `${sign} ${(low + at * (high - low)).toPrecision(3)} ${unit}`.trim();
    };
    return { part, image, scale, read, title: figure.querySelector("figcaption").textContent };
  };

  const open = (chosen) => {
    // drawings of rigs are compared with no image
    const isDrawing = ({ image }) => image.src.startsWith("data:image/svg");
    const group = [...chosen.closest(".maps, .pair").querySelectorAll(IMAGES)]
      .map(describe)
      .filter((one, _, all) => isDrawing(one) === isDrawing(all.find(({ part }) => part === chosen)));
    const names = group.map((one) => one.title);
    const first = group.findIndex((one) => one.part === chosen);
    const select = (label, index) => {
      const field = make("select", { "aria-label": label });
      names.forEach((name, i) => field.append(make("option", { value: i }, name)));
      field.value = index;
      return field;
    };
    const left = select("left image", first);
    const right = select("right image", group.length > 1 ? (first + 1) % group.length : first);
    const divider = make("input", { type: "range", min: 0, max: 100, value: group.length > 1 ? 50 : 100, "aria-label": "divider" });
    const values = make("output");
    const flip = make("button", { type: "button", "aria-pressed": "false" }, "Flip");
    const gain = make("input", { type: "range", min: 0, max: 32, value: 0, "aria-label": "gain of the difference" });
    const gainWords = make("label", { class: "gain" }, "Difference: off ", gain);
    const difference = make("canvas", { class: "difference", role: "img" });
    const bar = make("div");
    const point = make("div", { class: "point" });
    const stage = make("div", { class: "stage", tabindex: 0, role: "application", "aria-roledescription": "image probe", "aria-label": "Image: arrow keys read its values" });
    const close = make("button", { type: "button" }, "Close");
    const dialog = make("dialog", { class: "enlarged", "aria-label": names[first] });
    const controls = make("div", { class: "controls" }, left);
    if (group.length > 1) controls.append(divider, right);
    if (group.length > 1) controls.append(flip, gainWords);
    controls.append(close);
    dialog.append(controls, stage, bar, values);

    const shown = () => [group[left.value], group[right.value]];
    const draw = () => {
      const [a, b] = shown();
      stage.replaceChildren(
        make("img", { src: b.image.src, alt: b.image.alt }),
        make("img", { src: a.image.src, alt: a.image.alt, class: "over" }),
        point,
      );
      stage.style.setProperty("--divider", `${divider.value}%`);
      stage.style.setProperty("--aspect", a.image.naturalWidth / a.image.naturalHeight);
      subtract(a, b);
      const scales = new Map([b, a].filter((one) => one.scale).map((one) => [one.scale.parentElement.outerHTML, one]));
      bar.replaceChildren(
        ...[...scales.values()].reverse().map((one) => {
          const copy = one.scale.parentElement.cloneNode(true);
          if (scales.size > 1) copy.prepend(make("span", {}, one.title));
          return copy;
        }),
      );
      values.textContent = "Move the pointer over the image, or press arrow keys on it, for its values.";
    };
    // left minus right in sRGB, times the gain, around gray
    const subtract = (a, b) => {
      const factor = Number(gain.value);
      gainWords.firstChild.textContent = factor ? `Difference × ${factor} ` : "Difference: off ";
      gain.setAttribute("aria-valuetext", factor ? `times ${factor}` : "off");
      divider.disabled = factor > 0;
      if (!factor) {
        difference.remove();
        return;
      }
      const [width, height] = [a.image.naturalWidth, a.image.naturalHeight];
      [difference.width, difference.height] = [width, height];
      const context = difference.getContext("2d", { willReadFrequently: true });
      const [first, second] = [a, b].map((one) => {
        context.drawImage(one.image, 0, 0, width, height);
        return context.getImageData(0, 0, width, height);
      });
      first.data.forEach((code, i) => {
        if (i % 4 < 3) first.data[i] = 128 + factor * (code - second.data[i]);
      });
      context.putImageData(first, 0, 0);
      difference.setAttribute("aria-label", `${a.title} minus ${b.title}, times ${factor}, around gray`);
      stage.append(difference);
    };
    // both images in turn, twice a second
    let flipping = 0;
    const stop = () => {
      clearInterval(flipping);
      flipping = 0;
      flip.setAttribute("aria-pressed", "false");
    };
    flip.addEventListener("click", () => {
      if (flipping) return stop();
      flip.setAttribute("aria-pressed", "true");
      gain.value = 0;
      draw();
      flipping = setInterval(() => {
        divider.value = Number(divider.value) < 50 ? 100 : 0;
        stage.style.setProperty("--divider", `${divider.value}%`);
      }, FLIP_MS);
    });
    gain.addEventListener("input", () => {
      stop();
      subtract(...shown());
    });
    let probed = [0.5, 0.5]; // fractions of the width and height
    const probe = (u, v) => {
      probed = [u, v];
      stage.style.setProperty("--u", `${100 * u}%`);
      stage.style.setProperty("--v", `${100 * v}%`);
      const texts = [...new Set(shown())].map(({ image, read, title }) => {
        const [w, h] = [image.naturalWidth, image.naturalHeight];
        const [x, y] = [Math.min(w - 1, Math.floor(u * w)), Math.min(h - 1, Math.floor(v * h))];
        return `${title}: ${x < 0 || y < 0 ? "" : read(x, y)}`;
      });
      values.textContent = texts.join("; ");
    };
    stage.addEventListener("pointermove", (event) => {
      const box = stage.getBoundingClientRect();
      probe((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    });
    stage.addEventListener("keydown", (event) => {
      const step = ARROWS[event.key];
      if (!step) return;
      event.preventDefault();
      const { naturalWidth, naturalHeight } = shown()[0].image;
      const fast = event.shiftKey ? FAST_STEP_PX : 1;
      const center = (size, at, by) => (Math.min(size - 1, Math.max(0, Math.floor(at * size) + fast * by)) + 0.5) / size;
      probe(center(naturalWidth, probed[0], step[0]), center(naturalHeight, probed[1], step[1]));
    });
    for (const field of [left, right]) field.addEventListener("change", draw);
    divider.addEventListener("input", () => {
      stop();
      stage.style.setProperty("--divider", `${divider.value}%`);
    });
    close.addEventListener("click", () => dialog.close());
    dialog.addEventListener("close", () => {
      stop();
      dialog.remove();
    });
    document.body.append(dialog);
    draw();
    dialog.showModal();
  };

  for (const image of document.querySelectorAll(".maps img, .pair img")) {
    const title = image.closest("figure").querySelector("figcaption").textContent;
    const button = make("button", { type: "button", class: "enlarge", "aria-label": `Enlarge: ${title}. ${image.alt}` });
    image.replaceWith(button);
    button.append(image);
    button.addEventListener("click", () => open(image));
  }
})();
