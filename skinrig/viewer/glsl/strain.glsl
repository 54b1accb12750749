//@chunk strain_vertex
// The mesh in a window of its texture: u_window = (u, v) of the lower left corner and its sides.
in vec2 a_uv;
in vec3 a_tensor;
in vec3 a_metric;
uniform vec4 u_window;
out vec3 tensor;
out vec3 metric;
void main() {
  tensor = a_tensor;
  metric = a_metric;
  gl_Position = vec4(2.0 * (a_uv - u_window.xy) / u_window.zw - 1.0, 0.0, 1.0);
}

//@chunk strain_fragment
in vec3 tensor;
in vec3 metric;
layout(location = 0) out vec4 out_tensor;
layout(location = 1) out vec4 out_metric;
void main() {
  out_tensor = vec4(tensor, 1.0);
  out_metric = vec4(metric, 1.0);
}

//@chunk metric_fragment
in vec3 tensor;
in vec3 metric;
layout(location = 0) out vec4 out_metric;
void main() { out_metric = vec4(metric, 1.0); }

//@chunk strain_cover
in vec3 tensor;
in vec3 metric;
layout(location = 0) out vec4 covered;
void main() { covered = vec4(1.0); }

//@chunk principal
// Nagano 2015, eqs. 11 to 13, at a pixel: stretch ratios r_s >= r_t, their axes in pixels
// (x right, y up) and pixels per millimeter of neutral skin along them.
struct Principal { vec2 ratios; vec2 axis_s; vec2 axis_t; vec2 px_per_mm; };

const float EVEN = 1e-6;

Principal principal_strain(vec3 change, vec3 metric, vec2 pixels) {
  float mean = 0.5 * (change.x + change.z);
  float d = 0.5 * (change.x - change.z);
  float h = length(vec2(d, change.y));
  vec2 v = vec2(1.0, 0.0);
  if (2.0 * h > EVEN * (1.0 + mean + h)) {
    // half of the angle atan(q, d), by the root that does not cancel
    if (d >= 0.0) {
      float c = sqrt(0.5 * (1.0 + d / h));
      v = vec2(c, 0.5 * change.y / (h * c));
    } else {
      float s = sqrt(0.5 * (1.0 - d / h));
      v = vec2(0.5 * change.y / (h * s), s);
    }
  }
  vec2 s = pixels * vec2(metric.x * v.x + metric.y * v.y, metric.y * v.x + metric.z * v.y);
  vec2 t = pixels * vec2(metric.y * v.x - metric.x * v.y, metric.z * v.x - metric.y * v.y);
  float ls = length(s);
  float lt = length(t);
  Principal found;
  found.ratios = max(1.0 + mean + vec2(h, -h), 0.0);
  found.axis_s = ls > 0.0 ? s / ls : vec2(0.0);
  found.axis_t = lt > 0.0 ? t / lt : vec2(0.0);
  found.px_per_mm = vec2(ls, lt);
  return found;
}

//@chunk strain_view
// Stretch ratios and the axis of s at each pixel of the whole texture.
uniform vec2 u_pixels;
layout(location = 0) out vec4 ratios;
void main() {
  vec4 tensor = texel_strain_tensor(ivec2(gl_FragCoord.xy));
  vec4 metric = texel_strain_metric(ivec2(gl_FragCoord.xy));
  Principal found = principal_strain(tensor.xyz, metric.xyz, u_pixels);
  ratios = tensor.a > 0.5 ? vec4(found.ratios, found.axis_s) : vec4(1.0, 1.0, 0.0, 0.0);
}
