//@chunk picture_fragment
// Lambert's diffuse and GGX's surface reflection (Walter et al. 2007) of a picture's normals.
const float PICTURE_PI = 3.14159265358979;
const float PICTURE_F0 = 0.0278;  // refractive index 1.4
uniform vec3 u_light;
uniform float u_aspect;
in vec2 v_uv;
layout(location = 0) out vec4 o_radiance;
layout(location = 1) out vec4 o_normal;
layout(location = 2) out vec4 o_albedo;
#if defined(HAS_picture_height_um) || defined(HAS_picture_normal_stderr_deg)
layout(location = 3) out vec4 o_layers;
#endif
float smithGgx(float cosine, float alpha2) {
  return 2.0 / (1.0 + sqrt(1.0 + alpha2 * (1.0 / max(cosine * cosine, 1e-8) - 1.0)));
}
void main() {
  vec2 fit = u_aspect > p_picture_aspect ? vec2(u_aspect / p_picture_aspect, 1.0)
    : vec2(1.0, p_picture_aspect / u_aspect);
  vec2 uv = vec2(p_picture_x, p_picture_y) + (v_uv - 0.5) * fit / p_picture_zoom;
  vec3 at = vec3(uv, p_picture_state);
  vec3 packed_normal = sample_picture_normals(at).xyz;
  bool inside = all(greaterThanEqual(uv, vec2(0.0))) && all(lessThanEqual(uv, vec2(1.0)));
  float known = inside ? packed_normal.z : 0.0;
  vec3 n = vec3(packed_normal.xy, sqrt(max(1.0 - dot(packed_normal.xy, packed_normal.xy), 1e-6)));
  n = normalize(vec3(p_picture_slopes * n.xy, n.z));
#ifdef HAS_picture_color
  vec3 root = sample_picture_color(at).rgb;
  vec3 albedo = root * root;
#else
  vec3 albedo = vec3(0.5);
#endif
  float cosine = max(dot(n, u_light), 0.0);
  vec3 h = normalize(u_light + vec3(0.0, 0.0, 1.0));
  float alpha2 = pow(max(p_picture_roughness, 0.02), 2.0);
  float spread = dot(n, h) * dot(n, h) * (alpha2 - 1.0) + 1.0;
  float facets = alpha2 / (PICTURE_PI * spread * spread);
  float fresnel = PICTURE_F0 + (1.0 - PICTURE_F0) * pow(1.0 - max(h.z, 0.0), 5.0);
  float shine = facets * fresnel * smithGgx(cosine, alpha2) * smithGgx(max(n.z, 1e-4), alpha2)
    / (4.0 * max(n.z, 1e-4));
  vec3 lit = p_light_intensity * (albedo * cosine / PICTURE_PI + p_picture_specular * (cosine > 0.0 ? shine : 0.0));
  o_radiance = vec4(known * (lit + p_ambient * albedo), known);
  o_normal = vec4(known * n, known);
  o_albedo = vec4(known * albedo, known);
#if defined(HAS_picture_height_um) || defined(HAS_picture_normal_stderr_deg)
  float height = 0.0;
  float error_deg = 0.0;
#ifdef HAS_picture_height_um
  height = sample_picture_height_um(at).x;
#endif
#ifdef HAS_picture_normal_stderr_deg
  error_deg = sample_picture_normal_stderr_deg(at).x;
#endif
  o_layers = known * vec4(height, error_deg, 0.0, 1.0);
#endif
}
