// Settings in the URL: differences from the initial state, as name=value after the #.
V.flat = (value, before = "") => Object.entries(value).flatMap(([name, one]) => {
  const path = before + name;
  const deep = one && typeof one === "object" && !Array.isArray(one) && path !== "compare";
  return deep ? V.flat(one, `${path}.`) : [[path, one]];
});

V.differences = p => {
  const start = new Map(V.flat(V.initial).map(([name, value]) => [name, JSON.stringify(value)]));
  return V.flat(p).filter(([name, value]) => !V.transient(name) &&
    JSON.stringify(value) !== (start.get(name) ?? (/^(weights|traits)\./.test(name) ? "0" : undefined)));
};

V.addressOf = p => V.differences(p).map(([name, value]) =>
  `${name}=${encodeURIComponent(JSON.stringify(value))}`).join("&");

// Only existing parameters of the right type are read from a URL.
V.stateOfAddress = () => {
  const found = {};
  for (const part of location.hash.slice(1).split("&").filter(Boolean)) {
    const at = part.indexOf("=");
    const path = part.slice(0, at).split(".");
    let value;
    try { value = JSON.parse(decodeURIComponent(part.slice(at + 1))); } catch { continue; }
    const known = V.at(V.initial, path);
    const named = path.length === 2 && (path[0] === "weights" || path[0] === "traits");
    const free = known === null || (path[0] === "compare" && path.length === 1);
    if (known === undefined && !named) continue;
    if (!free && typeof value !== typeof (known ?? 0)) continue;
    if (Array.isArray(known) && (!Array.isArray(value) || value.length !== known.length)) continue;
    if (typeof value === "number" && !Number.isFinite(value)) continue;
    let inner = found;
    path.slice(0, -1).forEach(name => { inner = (inner[name] ??= {}); });
    inner[path.at(-1)] = value;
  }
  return found;
};

V.rememberNow = p => {
  const text = V.addressOf(p);
  history.replaceState(null, "", text ? `#${text}` : location.pathname + location.search);
};
V.rememberState = p => {
  clearTimeout(V.remembering);
  V.remembering = setTimeout(() => V.rememberNow(p), 400);
};
