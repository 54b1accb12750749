// WebGL2: context, formats, programs with their declarations, textures, targets, reading back.
V.FORMATS = {
  R8: ["RED", "UNSIGNED_BYTE", 1, 1], RG8: ["RG", "UNSIGNED_BYTE", 2, 2],
  RGB8: ["RGB", "UNSIGNED_BYTE", 3, 3], RGBA8: ["RGBA", "UNSIGNED_BYTE", 4, 4],
  R16F: ["RED", "HALF_FLOAT", 1, 2], RG16F: ["RG", "HALF_FLOAT", 2, 4],
  RGB16F: ["RGB", "HALF_FLOAT", 3, 6], RGBA16F: ["RGBA", "HALF_FLOAT", 4, 8],
  R32F: ["RED", "FLOAT", 1, 4], RG32F: ["RG", "FLOAT", 2, 8],
  RGB32F: ["RGB", "FLOAT", 3, 12], RGBA32F: ["RGBA", "FLOAT", 4, 16],
};

V.openContext = canvas => {
  const gl = canvas.getContext("webgl2", {
    alpha: false, antialias: false, depth: false, stencil: false, preserveDrawingBuffer: true,
  });
  if (!gl) {
    throw new Error("this browser does not support WebGL2; open the page in a current Chrome, Firefox " +
      "or Safari with hardware acceleration");
  }
  if (!gl.getExtension("EXT_color_buffer_float")) {
    throw new Error("this graphics driver does not support float render targets " +
      "(EXT_color_buffer_float); try another browser or device");
  }
  V.gl = gl;
  V.floatLinear = Boolean(gl.getExtension("OES_texture_float_linear"));
  V.programs = new Map();
  V.vao = gl.createVertexArray();
};

// Build, or find, the program of some chunks. Names of the protocol are declared here.
V.program = (vertex, fragment, defines = {}) => {
  const key = JSON.stringify([vertex, fragment, defines]);
  if (V.programs.has(key)) return V.programs.get(key);
  const gl = V.gl;
  const text = names => names.map(name => {
    if (!(name in V.glsl)) throw new Error(`GLSL chunk ${name} does not exist`);
    return V.glsl[name];
  }).join("\n");
  const head = stage => [
    "#version 300 es",
    "precision highp float;\nprecision highp int;\nprecision highp sampler2D;",
    "precision highp sampler2DArray;",
    ...V.knownNames().map(name => `#define HAS_${name} 1`),
    ...Object.entries(defines).map(([name, value]) => `#define ${name} ${value}`),
    V.declarations(stage),
  ].join("\n");
  const program = gl.createProgram();
  const bodies = [[gl.VERTEX_SHADER, text(vertex)], [gl.FRAGMENT_SHADER, text(fragment)]];
  for (const [kind, body] of bodies) {
    const shader = gl.createShader(kind);
    const source = `${head(body)}\n${body}`;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
      const numbered = source.split("\n").map((line, i) => `${i + 1}: ${line}`).join("\n");
      throw new Error(`${vertex} + ${fragment}: ${gl.getShaderInfoLog(shader)}\n${numbered}`);
    }
    gl.attachShader(program, shader);
  }
  for (const [name, at] of Object.entries(V.ATTRIBUTES)) gl.bindAttribLocation(program, at, name);
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    throw new Error(`${vertex} + ${fragment}: ${gl.getProgramInfoLog(program)}`);
  }
  const uniforms = new Map();
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < count; i++) {
    const info = gl.getActiveUniform(program, i);
    const name = info.name.replace("[0]", "");
    uniforms.set(name, {...{type: info.type, size: info.size, name},
      at: gl.getUniformLocation(program, info.name)});
  }
  const built = {handle: program, uniforms};
  V.programs.set(key, built);
  return built;
};

V.ATTRIBUTES = {a_position: 0, a_normal: 1, a_uv: 2, a_tangent: 3, a_bitangent: 4};

V.knownNames = () => [
  ...Object.keys(V.scene.textures), ...Object.keys(V.scene.tables),
  ...V.passes.flatMap(pass => Object.keys(pass.targets(V.params))),
];

// Declarations of the protocol's names that a text uses.
V.declarations = text => {
  const used = pattern => [...new Set([...text.matchAll(pattern)].map(found => found[1]))].sort();
  const lines = [];
  for (const name of used(/\bp_(\w+)\b/g)) {
    const value = V.params[name];
    if (value === undefined) throw new Error(`parameter ${name} is used in GLSL but not set`);
    lines.push(`uniform ${Array.isArray(value) ? `vec${value.length}` : "float"} p_${name};`);
  }
  for (const name of used(/\bsample_(\w+)\s*\(/g)) {
    const texture = V.scene.textures[name];
    if (!texture) continue; // its caller is within #ifdef HAS_name
    if (texture.layers) {
      lines.push(`uniform sampler2DArray t_${name};`,
        `uniform vec4 t_${name}_low[${texture.layers}];`,
        `uniform vec4 t_${name}_span[${texture.layers}];`,
        `vec4 sample_${name}(vec3 at) { int l = int(at.z + 0.5); return t_${name}_low[l] + ` +
        `t_${name}_span[l] * texture(t_${name}, at); }`);
    } else {
      lines.push(`uniform sampler2D t_${name};`, `uniform vec4 t_${name}_low;`,
        `uniform vec4 t_${name}_span;`,
        `vec4 sample_${name}(vec2 at) { return t_${name}_low + t_${name}_span * ` +
        `texture(t_${name}, at); }`);
    }
  }
  for (const name of used(/\btable_(\w+)\s*\(/g)) {
    if (!(name in V.scene.tables)) continue;
    lines.push(`uniform sampler2D l_${name};`,
      `vec4 table_${name}(vec2 at) { return texture(l_${name}, at); }`);
  }
  const buffers = new Set([...used(/\bbuffer_(\w+)\s*\(/g), ...used(/\btexel_(\w+)\s*\(/g)]);
  for (const name of buffers) {
    lines.push(`uniform sampler2D b_${name};`,
      `vec4 buffer_${name}(vec2 at) { return texture(b_${name}, at); }`,
      `vec4 texel_${name}(ivec2 at) { return texelFetch(b_${name}, at, 0); }`);
  }
  return lines.join("\n");
};

// Use a program with the protocol's names bound and further uniforms (u_name) set.
V.use = (program, side, p, uniforms = {}) => {
  const gl = V.gl;
  gl.useProgram(program.handle);
  // bound after all uploads, as an upload uses the first unit
  const bound = [];
  const bind = (info, texture, target = gl.TEXTURE_2D) => bound.push([info, texture, target]);
  for (const [name, info] of program.uniforms) {
    const rest = name.slice(2);
    if (name in uniforms) {
      if (info.type === gl.SAMPLER_2D) bind(info, uniforms[name]);
      else V.setUniform(info, uniforms[name]);
    } else if (name.startsWith("p_")) {
      V.setUniform(info, Number.isFinite(p[rest]) || Array.isArray(p[rest]) ? p[rest]
        : Number(p[rest]));
    } else if (name.startsWith("t_") && name.endsWith("_low")) {
      V.setUniform(info, V.textureOfPerson(rest.slice(0, -4), p).low);
    } else if (name.startsWith("t_") && name.endsWith("_span")) {
      V.setUniform(info, V.textureOfPerson(rest.slice(0, -5), p).span);
    } else if (name.startsWith("t_")) {
      const texture = V.textureOfPerson(rest, p);
      bind(info, texture.handle, texture.target);
    } else if (name.startsWith("l_")) {
      bind(info, V.tableOf(rest));
    } else if (name.startsWith("b_")) {
      bind(info, side.buffers.get(rest)?.texture ?? V.zeroTexture());
    } else {
      throw new Error(`uniform ${name} was not set`);
    }
  }
  bound.forEach(([info, texture, target], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(target, texture);
    gl.uniform1i(info.at, unit);
  });
};

V.setUniform = (info, value) => {
  const gl = V.gl;
  switch (info.type) {
    case gl.FLOAT: gl.uniform1fv(info.at, typeof value === "number" ? [value] : value); break;
    case gl.FLOAT_VEC2: gl.uniform2fv(info.at, value); break;
    case gl.FLOAT_VEC3: gl.uniform3fv(info.at, value); break;
    case gl.FLOAT_VEC4: gl.uniform4fv(info.at, value); break;
    case gl.INT: gl.uniform1i(info.at, value); break;
    case gl.INT_VEC2: gl.uniform2iv(info.at, value); break;
    case gl.FLOAT_MAT3: gl.uniformMatrix3fv(info.at, false, value); break;
    case gl.FLOAT_MAT4: gl.uniformMatrix4fv(info.at, false, value); break;
    default: throw new Error(`uniform ${info.name}: unknown type`);
  }
};

V.newTexture = (format, size, {data = null, filter = "linear", mip = false, layers = 0} = {}) => {
  const gl = V.gl;
  const [layout, type] = V.FORMATS[format];
  const target = layers ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D;
  const linear = filter !== "nearest" && (V.floatLinear || type !== "FLOAT");
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(target, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  if (layers) {
    gl.texImage3D(target, 0, gl[format], size[0], size[1], layers, 0, gl[layout], gl[type], data);
  } else {
    gl.texImage2D(target, 0, gl[format], size[0], size[1], 0, gl[layout], gl[type], data);
  }
  const between = linear ? gl.LINEAR : gl.NEAREST;
  gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, between);
  gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, mip && linear ? gl.LINEAR_MIPMAP_LINEAR : between);
  gl.texParameteri(target, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  if (mip && data) gl.generateMipmap(target);
  return texture;
};

V.zeroTexture = () => (V.zero ??= V.newTexture("RGBA8", [1, 1], {data: new Uint8Array(4)}));

// Textures of person k > 0 are named NAME_person_k; others are shared by all people.
Object.assign(V.defaults, {person: 0});
V.textureOfPerson = (name, p) => {
  const own = `${name}_person_${p.person}`;
  return V.textureOf(own in V.scene.textures ? own : name);
};

// A scene texture on the device; 16-bit words become floats, since WebGL2 has no such format.
V.uploads = new Map();
V.textureOf = name => {
  if (V.uploads.has(name)) return V.uploads.get(name);
  const t = V.scene.textures[name];
  const count = t.channels;
  const kind = ["R", "RG", "RGB", "RGBA"][count - 1];
  const format = kind + {u8: "8", u16: "32F", f16: "16F", f32: "32F"}[t.storage];
  const data = t.storage === "u16" ? Float32Array.from(t.data, word => word / 65535) : t.data;
  const handle = V.newTexture(format, [t.width, t.height],
    {data, layers: t.layers, filter: t.filter, mip: t.filter === "mipmap"});
  const rows = t.layers ? t.low.map((low, i) => [low, t.high[i]]) : [[t.low, t.high]];
  const pad = values => [...values, 0, 0, 0, 0].slice(0, 4);
  const made = {
    handle,
    target: t.layers ? V.gl.TEXTURE_2D_ARRAY : V.gl.TEXTURE_2D,
    low: rows.flatMap(([low]) => pad(low)),
    span: rows.flatMap(([low, high]) => pad(high.map((value, i) => value - low[i]))),
  };
  V.uploads.set(name, made);
  return made;
};

V.tableUploads = new Map();
V.tableOf = name => {
  if (V.tableUploads.has(name)) return V.tableUploads.get(name);
  const table = V.scene.tables[name];
  const [rows, columns, channels] = table.shape;
  const format = ["R32F", "RG32F", "RGB32F", "RGBA32F"][channels - 1];
  const handle = V.newTexture(format, [columns, rows], {data: table.data});
  V.tableUploads.set(name, handle);
  return handle;
};

// Buffers of a pass on one side, recreated if a size or format changed.
V.target = (side, pass, shapes) => {
  const gl = V.gl;
  const signature = JSON.stringify(shapes);
  const old = side.targets.get(pass.name);
  const owner = side.targets.get(pass.depth) ?? null;
  if (old && old.signature === signature && old.owner === owner) return old;
  V.freeTarget(side, pass);
  const names = Object.keys(shapes);
  const size = names.length ? shapes[names[0]].size : [V.canvas.width, V.canvas.height];
  const target = {pass, signature, size, names, shapes, textures: [], depth: null, owner, frame: null};
  if (names.length) {
    target.frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    names.forEach((name, i) => {
      const shape = shapes[name];
      const texture = V.newTexture(shape.format, shape.size, {filter: shape.filter, mip: shape.mip});
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
      target.textures.push(texture);
      side.buffers.set(name, {texture, target, index: i, ...shape});
    });
    if (pass.depth === true) {
      target.depth = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, target.depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, size[0], size[1]);
    }
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, (owner ?? target).depth);
    gl.drawBuffers(names.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) {
      throw new Error(`pass ${pass.name}: its buffers cannot be drawn into on this device`);
    }
  }
  side.targets.set(pass.name, target);
  return target;
};

V.freeTarget = (side, pass) => {
  const gl = V.gl;
  const target = side.targets.get(pass.name);
  if (!target) return;
  target.textures.forEach(texture => gl.deleteTexture(texture));
  target.names.forEach(name => side.buffers.delete(name));
  if (target.depth) gl.deleteRenderbuffer(target.depth);
  if (target.frame) gl.deleteFramebuffer(target.frame);
  side.targets.delete(pass.name);
};

V.bindTarget = target => {
  const gl = V.gl;
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
  gl.viewport(0, 0, target.size[0], target.size[1]);
  gl.disable(gl.BLEND);
  gl.disable(gl.CULL_FACE);
  gl.depthMask(Boolean(target.depth));
  gl.depthFunc(gl.LESS);
  if (target.depth || target.owner) gl.enable(gl.DEPTH_TEST);
  else gl.disable(gl.DEPTH_TEST);
};

V.finishTarget = target => {
  const gl = V.gl;
  target.names.forEach((name, i) => {
    if (!target.shapes[name].mip) return;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, target.textures[i]);
    gl.generateMipmap(gl.TEXTURE_2D);
  });
};

// Drawing context of a pass.
V.context = (side, p, target) => ({
  p, side, size: target.size,
  clear: (...color) => {
    V.gl.clearColor(...color);
    V.gl.clearDepth(1);
    V.gl.clear(V.gl.COLOR_BUFFER_BIT | (target.depth ? V.gl.DEPTH_BUFFER_BIT : 0));
  },
  mesh: (program, uniforms = {}) => {
    V.use(program, side, p, uniforms);
    V.drawMesh(side, p);
  },
  full: (program, uniforms = {}) => {
    V.use(program, side, p, uniforms);
    V.gl.bindVertexArray(V.vao);
    V.gl.depthFunc(V.gl.GREATER);
    V.gl.drawArrays(V.gl.TRIANGLES, 0, 3);
  },
});

// A buffer as floats, row 0 at the top.
V.read = (side, name) => {
  const gl = V.gl;
  const buffer = side.buffers.get(name);
  if (!buffer) throw new Error(`buffer ${name} does not exist`);
  const [width, height] = buffer.size;
  const channels = V.FORMATS[buffer.format][2];
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer.target.frame);
  gl.readBuffer(gl.COLOR_ATTACHMENT0 + buffer.index);
  const bytes = V.FORMATS[buffer.format][1] === "UNSIGNED_BYTE";
  const all = bytes ? new Uint8Array(width * height * 4) : new Float32Array(width * height * 4);
  gl.readPixels(0, 0, width, height, gl.RGBA, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, all);
  gl.readBuffer(gl.COLOR_ATTACHMENT0);
  const data = new Float32Array(width * height * channels);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      for (let c = 0; c < channels; c++) {
        data[(y * width + x) * channels + c] =
          all[((height - 1 - y) * width + x) * 4 + c] / (bytes ? 255 : 1);
      }
    }
  }
  return {width, height, channels, values: data};
};
