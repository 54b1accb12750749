//@chunk pad_fragment
// Where a pixel of the window has its strain from: itself, or up to 4 pixels around islands the
// neighbor that model/strain_fields.py carries on (sides before corners, then in reading order;
// rows from the top). Alpha is 0 where nothing is known.
layout(location = 0) out vec4 source;
const int PAD = 4;
ivec2 size_px;

bool covered(ivec2 at) {
  if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size_px))) return false;
  return texel_window_cover(at).r > 0.5;
}

// Pixels to the nearest covered one by a king's moves; PAD + 1: farther than that.
int moves(ivec2 at) {
  if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size_px))) return PAD + 1;
  if (covered(at)) return 0;
  for (int ring = 1; ring <= PAD; ring++) {
    for (int i = -ring; i <= ring; i++) {
      if (covered(at + ivec2(i, ring)) || covered(at + ivec2(i, -ring)) ||
          covered(at + ivec2(ring, i)) || covered(at + ivec2(-ring, i))) return ring;
    }
  }
  return PAD + 1;
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  size_px = ivec2(p_microstructure_side_px);
  int left = moves(at);
  source = vec4(0.0);
  if (left > PAD) return;
  while (left > 0) {
    bool found = false;
    ivec2 next = at;
    for (int corner = 0; corner < 2 && !found; corner++) {
      for (int row = 1; row >= -1 && !found; row--) {
        for (int column = -1; column <= 1 && !found; column++) {
          bool straight = row == 0 || column == 0;
          if (straight != (corner == 0) || (row == 0 && column == 0)) continue;
          if (moves(at + ivec2(column, row)) == left - 1) {
            found = true;
            next = at + ivec2(column, row);
          }
        }
      }
    }
    if (!found) return;
    at = next;
    left -= 1;
  }
  source = vec4(vec2(at), 0.0, 1.0);
}

//@chunk relief_fragment
// A displacement of any size grown from one patch: skinrig/viewer/relief_growth.py has the
// definition. Rows count from the top there.
layout(location = 0) out vec4 height;
uniform sampler2D u_patch;  // its levels side by side
uniform ivec2 u_origin;    // column and row (from the top) of the window's upper left pixel
uniform ivec2 u_growth;    // edge of the lattice's triangles, and moves to choose from
uniform vec2 u_seed;       // low and high 16 bits
const int STEP = 8;

uint hashed(int i, int j) {
  uint seed = uint(u_seed.x) | (uint(u_seed.y) << 16);
  uint h = (uint(i) * 0x9E3779B1u) ^ (uint(j) * 0x85EBCA77u) ^ seed;
  h = (h ^ (h >> 16)) * 0x85EBCA6Bu;
  h = (h ^ (h >> 13)) * 0xC2B2AE35u;
  return h ^ (h >> 16);
}

float placed(ivec2 corner, ivec2 at, int level) {
  int cell = u_growth.x;
  ivec2 px = ivec2(((2 * corner.x + corner.y) * cell) >> 1, (corner.y * cell * 14189) >> 14);
  px = (px >> 3) << 3;
  uint drawn = hashed(corner.x, corner.y);
  uint choices = uint(u_growth.y);
  ivec2 free = STEP * ivec2(int((drawn & 0xFFFFu) % choices), int((drawn >> 16) % choices));
  int reach = STEP * ((cell + STEP + 1 + STEP - 1) / STEP);
  ivec2 from = at + ((free + reach - px) >> level);
  int side = textureSize(u_patch, 0).y;
  // rows of the patch are counted from the bottom in GL
  int first = 0;
  int rows = side;
  for (int l = 0; l < level; l++) { first += rows; rows /= 2; }
  return texelFetch(u_patch, ivec2(first + from.x, rows - 1 - from.y), 0).r;
}

void main() {
  int level = int(p_microstructure_place.z + 0.5);
  int n = int(p_microstructure_side_px);
  ivec2 at = u_origin + ivec2(int(gl_FragCoord.x), n - 1 - int(gl_FragCoord.y));
  vec2 cells = (vec2(at) + 0.5) * exp2(float(level)) / float(u_growth.x);
  float down = cells.y * 1.1547005383792515;
  float right = cells.x - 0.5 * down;
  ivec2 base = ivec2(floor(right), floor(down));
  float p = right - float(base.x);
  float q = down - float(base.y);
  float rest = 1.0 - p - q;
  bool upper = rest > 0.0;
  vec3 w = upper ? vec3(rest, q, p) : vec3(-rest, 1.0 - p, 1.0 - q);
  w *= w;
  w *= w;
  w /= length(w);
  float h = w.x * placed(base + (upper ? ivec2(0) : ivec2(1)), at, level);
  h += w.y * placed(base + ivec2(0, 1), at, level);
  h += w.z * placed(base + ivec2(1, 0), at, level);
  height = vec4(h, 0.0, 0.0, 1.0);
}

//@chunk kernel_lookup
// Strength and width of the kernel of each axis (Nagano 2015, eqs. 8 and 9; the scene's table).
uniform float u_breaks[8];
uniform vec2 u_lines[9];
uniform int u_break_count;
uniform vec2 u_sigma_lines[2];   // mm, below and above a ratio of 1
uniform vec2 u_ends;             // ratios are held within these
uniform vec2 u_limits;           // and alpha within these

struct LineKernel { vec2 axis; float alpha; float sigma_px; };

vec2 kernel_of(float ratio, float px_per_mm) {
  float r = clamp(ratio, u_ends.x, u_ends.y);
  int line = 0;
  for (int i = 0; i < 8; i++) { if (i < u_break_count && r > u_breaks[i]) line = i + 1; }
  float alpha = clamp(u_lines[line].x * r + u_lines[line].y, u_limits.x, u_limits.y);
  vec2 slope = r < 1.0 ? u_sigma_lines[0] : u_sigma_lines[1];
  return vec2(r == 1.0 ? 0.0 : alpha, max(slope.x * r + slope.y, 0.0) * px_per_mm);
}

// The kernel of pass 0 (along s) or 1 (along t) at a pixel of the window.
LineKernel kernel_at(ivec2 at, int axis) {
  LineKernel found = LineKernel(vec2(0.0), 0.0, 0.0);
  vec4 source = texel_window_pad(at);
  if (source.a < 0.5) return found;
  ivec2 from = ivec2(source.xy);
  float virtual_px = floor(p_microstructure_virtual_px / exp2(p_microstructure_place.z));
  Principal strain = principal_strain(texel_window_tensor(from).xyz,
    texel_window_metric(from).xyz, vec2(virtual_px));
  if (strain.px_per_mm.x <= 0.0 || strain.px_per_mm.y <= 0.0) return found;
  found.axis = axis == 0 ? strain.axis_s : strain.axis_t;
  float ratio = axis == 0 ? strain.ratios.x : strain.ratios.y;
  float scale = axis == 0 ? strain.px_per_mm.x : strain.px_per_mm.y;
  vec2 kernel = kernel_of(ratio, scale);
  found.alpha = kernel.x;
  found.sigma_px = kernel.y;
  return found;
}

//@chunk kernel_fragment
layout(location = 0) out vec4 along_s;
layout(location = 1) out vec4 along_t;
void main() {
  LineKernel s = kernel_at(ivec2(gl_FragCoord.xy), 0);
  LineKernel t = kernel_at(ivec2(gl_FragCoord.xy), 1);
  along_s = vec4(s.axis, s.alpha, s.sigma_px);
  along_t = vec4(t.axis, t.alpha, t.sigma_px);
}

//@chunk line_convolution
// One pass along each pixel's own line (eqs. 3 and 6): h + alpha (G * h - h), the Gaussian at
// whole steps of a pixel within 4 sigmas; samples between pixels by Keys' cubic or bilinearly, as
// model/displacement_convolution.py's. Mirrored at the map's borders; beyond the window, whose
// margin is as wide as both passes reach, the nearest pixel holds.
uniform sampler2D u_source;
uniform int u_axis;

ivec2 window_last;
float at_px(ivec2 at) {
#if MIRRORED
  ivec2 place = ivec2(p_microstructure_place.xy);
  ivec2 whole = ivec2(floor(p_microstructure_virtual_px / exp2(p_microstructure_place.z)));
  ivec2 g = at + place;
  if (g.x < 0) g.x = -1 - g.x;
  if (g.y < 0) g.y = -1 - g.y;
  if (g.x >= whole.x) g.x = 2 * whole.x - 1 - g.x;
  if (g.y >= whole.y) g.y = 2 * whole.y - 1 - g.y;
  at = g - place;
#endif
  return texelFetch(u_source, clamp(at, ivec2(0), window_last), 0).r;
}

vec4 keys(float f) {
  float f2 = f * f;
  float f3 = f2 * f;
  return vec4(f2 - 0.5 * (f + f3), 1.0 - 2.5 * f2 + 1.5 * f3, 0.5 * f + 2.0 * f2 - 1.5 * f3,
    0.5 * (f3 - f2));
}

float between(ivec2 at, vec2 by) {
  vec2 whole = floor(by);
  vec2 f = by - whole;
  ivec2 from = at + ivec2(whole);
#if !CUBIC
  return mix(mix(at_px(from), at_px(from + ivec2(1, 0)), f.x),
    mix(at_px(from + ivec2(0, 1)), at_px(from + ivec2(1, 1)), f.x), f.y);
#else
  vec4 cx = keys(f.x);
  vec4 cy = keys(f.y);
  float total = 0.0;
  for (int row = 0; row < 4; row++) {
    float line = 0.0;
    for (int column = 0; column < 4; column++) {
      line += cx[column] * at_px(from + ivec2(column - 1, row - 1));
    }
    total += cy[row] * line;
  }
  return total;
#endif
}

layout(location = 0) out vec4 height;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  window_last = textureSize(u_source, 0) - 1;
  float own = texelFetch(u_source, at, 0).r;
  LineKernel kernel = kernel_at(at, u_axis);
  int radius = min(int(4.0 * kernel.sigma_px + 0.5), 64);
  height = vec4(own, 0.0, 0.0, 1.0);
  if (kernel.alpha == 0.0 || radius == 0) return;
  float e = exp(-0.5 / (kernel.sigma_px * kernel.sigma_px));
  if (e < 1e-8) return;
  float total = 0.0;
  float norm = 1.0;
  for (int i = 1; i <= radius; i++) {
    float w = pow(e, float(i * i));
    vec2 by = float(i) * kernel.axis;
    total += w * (between(at, by) + between(at, -by) - 2.0 * own);
    norm += 2.0 * w;
  }
  height.r = own + kernel.alpha * total / norm;
}

//@chunk relief_derivatives
// Partial derivatives n_x / n_z, n_y / n_z of the relief on the moved skin, in the texture's
// tangent frame: central differences of heights, by the metric to millimeters of neutral skin and
// by the stretch to those of the moved one. First two: after the strain; last two: the neutral
// relief on the same skin, as a static displacement map would be shown.
uniform sampler2D u_moved;
uniform sampler2D u_neutral;
layout(location = 0) out vec4 derivatives;

vec2 gradient_px(sampler2D heights, ivec2 at) {
  ivec2 last = textureSize(heights, 0) - 1;
  ivec2 a = max(at - 1, ivec2(0));
  ivec2 b = min(at + 1, last);
  return vec2(
    texelFetch(heights, ivec2(b.x, at.y), 0).r - texelFetch(heights, ivec2(a.x, at.y), 0).r,
    texelFetch(heights, ivec2(at.x, b.y), 0).r - texelFetch(heights, ivec2(at.x, a.y), 0).r)
    / vec2(b - a);
}

// Heights in micrometers per pixel to slopes.
vec2 on_skin(vec2 gradient, vec3 change, vec3 metric, float pixels) {
  vec2 g = 1e-3 * pixels * gradient;
  g = vec2(metric.x * g.x + metric.y * g.y, metric.y * g.x + metric.z * g.y);
  // (1 + change)^-1 g
  vec3 t = vec3(1.0, 0.0, 1.0) + change;
  float det = t.x * t.z - t.y * t.y;
  return vec2(t.z * g.x - t.y * g.y, t.x * g.y - t.y * g.x) / max(det, 1e-4);
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 source = texel_window_pad(at);
  derivatives = vec4(0.0);
  if (source.a < 0.5) return;
  ivec2 from = ivec2(source.xy);
  vec3 change = texel_window_tensor(from).xyz;
  vec3 metric = texel_window_metric(from).xyz;
  float pixels = floor(p_microstructure_virtual_px / exp2(p_microstructure_place.z));
  derivatives = vec4(-on_skin(gradient_px(u_moved, at), change, metric, pixels),
    -on_skin(gradient_px(u_neutral, at), change, metric, pixels));
}

//@chunk microstructure_surface
// What of the microstructure a pixel shows: slopes where the window holds them; the variance of
// slopes that are not drawn goes into the roughness (m^2 = 2 variance along one axis). The scene's
// roughness is that of neutral skin with all of its microstructure.
const float LEAST_ROUGHNESS = 0.1;

float microstructureMode() {
  if (p_microstructure < 2.5) return p_microstructure;
  return floor(3.0 * gl_FragCoord.x / p_microstructure_split_px);  // off | static | dynamic
}

vec4 microstructureAt(vec2 uv, out float shown) {
  shown = 0.0;
#if !MICROSTRUCTURE
  return vec4(0.0);
#else
  float whole = floor(p_microstructure_virtual_px / exp2(p_microstructure_place.z));
  vec2 at = uv * whole - p_microstructure_place.xy;
  vec2 inside = min(at, p_microstructure_side_px - at) - p_microstructure_margin_px;
  shown = smoothstep(0.0, 24.0, min(inside.x, inside.y)) * step(0.5, p_microstructure_place.w);
  return buffer_microstructure(at / p_microstructure_side_px);
#endif
}

// Variance of slopes along one axis, relative to neutral skin's.
float strainedVariance(vec2 uv) {
  vec3 change = buffer_strain_tensor(uv).xyz;
  float mean = 0.5 * (change.x + change.z);
  float h = length(vec2(0.5 * (change.x - change.z), change.y));
  vec2 ratios = 1.0 + mean + vec2(h, -h);
  // rows are r_s, columns r_t; nodes lie at the centers of texels
  vec2 nodes = p_variance_stretch.xy;
  vec2 at = (clamp(ratios.yx, nodes.x, nodes.y) - nodes.x) / (nodes.y - nodes.x);
  float count = p_variance_stretch.z;
  vec4 both = table_strained_variance((at * (count - 1.0) + 0.5) / count);
  return 0.5 * (both.r + both.g);
}

// From the frame in which the texture's map is symmetric (its rotation is the closest to the map)
// to the surface's own, whose first axis runs along u.
vec2 onSurface(SurfacePoint s, vec2 d) {
  vec2 dv = vec2(dot(v_bitangent, s.tangent), dot(v_bitangent, s.bitangent));
  vec2 turn = normalize(vec2(dot(v_tangent, s.tangent) + dv.y, -dv.x));
  return vec2(turn.x * d.x - turn.y * d.y, turn.y * d.x + turn.x * d.y);
}

void adjustMicrostructure(inout SurfacePoint s) {
  float shown;
  vec4 both = microstructureAt(s.uv, shown);
  float factor = strainedVariance(s.uv);
  float mode = microstructureMode();
  vec2 derivatives = shown * (mode > 1.5 ? both.xy : both.zw);
  float total = p_microstructure_variance.x;
  if (mode < 0.5) {
    derivatives = vec2(0.0);
    total = 0.0;
  } else {
    float drawn = shown * shown * p_microstructure_variance.y;
    total = (total - drawn) * (mode > 1.5 ? factor : 1.0);
  }
  s.specularNormal = tilted(s, s.slope - onSurface(s, derivatives));
  s.unseen += total - p_microstructure_variance.x;
  float m2 = s.roughness * s.roughness + 2.0 * (total - p_microstructure_variance.x);
  float least = min(s.roughness, LEAST_ROUGHNESS);
  s.roughness = sqrt(max(m2, least * least));
}
