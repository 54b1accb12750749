//@chunk eye_noise
float hash2(vec2 at) { return fract(sin(dot(at, vec2(127.1, 311.7))) * 43758.5453); }
float smoothNoise(vec2 at) {
  vec2 cell = floor(at);
  vec2 part = at - cell;
  part *= part * (3.0 - 2.0 * part);
  return mix(mix(hash2(cell), hash2(cell + vec2(1.0, 0.0)), part.x),
    mix(hash2(cell + vec2(0.0, 1.0)), hash2(cell + vec2(1.0, 1.0)), part.x), part.y);
}
//@chunk eye_fragment
// v_normal: mm below the upper margin; 1 at the upper, -1 at the lower edge; share from the inner
// to the outer corner.
uniform vec3 u_eye;
uniform vec3 u_to_light;
uniform vec3 u_ball;
uniform vec3 u_gaze;
uniform vec3 u_iris;
in float v_depth;
layout(location = 0) out vec4 o_irradiance;
layout(location = 1) out vec4 o_albedo;
layout(location = 2) out vec4 o_specular;
const vec3 FLESH = vec3(0.46, 0.25, 0.21);
float meet(vec3 from, vec3 way, float radius) {
  float b = dot(from, way);
  float rest = b * b - dot(from, from) + radius * radius;
  return rest > 0.0 ? -b - sqrt(rest) : -1.0;
}
vec3 irisColor(vec3 at, vec3 right, vec3 up, out float reach) {
  vec2 plane = vec2(dot(at, right), dot(at, up));
  reach = length(plane) / 6.1;
  vec2 way = plane / max(length(plane), 1e-3);
  float fibers = smoothNoise(way * 13.0 + reach * 2.2) * 0.6 + smoothNoise(way * 31.0 - reach * 4.0) * 0.4;
  float collarette = exp(-pow((reach - 0.47 - 0.05 * fibers) / 0.09, 2.0));
  vec3 color = u_iris * (0.45 + 1.15 * fibers);
  color = mix(color, color * vec3(1.5, 1.15, 0.8) + 0.012, 0.55 * collarette);
  color *= 1.0 - 0.72 * smoothstep(0.76, 0.97, reach);
  return mix(vec3(0.002), color, smoothstep(0.33, 0.37, reach));
}
float glint(vec3 n, vec3 light, vec3 eye, float alpha) {
  vec3 h = normalize(light + eye);
  float c = max(dot(n, h), 0.0);
  float d = c * c * (alpha * alpha - 1.0) + 1.0;
  float base = 1.0 - max(dot(eye, h), 0.0);
  float fresnel = 0.025 + 0.975 * pow(base, 5.0);
  float facing = max(dot(n, light), 0.0) * max(dot(n, eye), 0.05);
  float shade = facing / (mix(max(dot(n, light), 0.05), 1.0, 0.5 * alpha) * mix(max(dot(n, eye), 0.05), 1.0, 0.5 * alpha));
  return alpha * alpha / (PI * d * d) * fresnel * shade / (4.0 * max(facing, 0.02));
}
// Diffuse light and highlight of one light, of its intensity after shadows.
float diffuseFrom(float intensity, vec3 light, vec3 n, vec3 beside, float below) {
  float wrapped = clamp((dot(n, light) + 0.12) / 1.12, 0.0, 1.0);
  // the cornea gathers light on the far side of the iris
  float caustic = 1.0 - 0.5 * dot(beside, light - dot(light, u_gaze) * u_gaze) / 6.0;
  return intensity * wrapped * caustic * mix(0.55, 1.0, below);
}
float highlightFrom(float intensity, vec3 light, vec3 n, vec3 eye, float alpha) {
  return PI * intensity * max(dot(n, light), 0.0) * glint(n, light, eye, alpha);
}
void main() {
  vec3 way = normalize(v_position - u_eye);
  vec3 from = u_eye - u_ball;
  vec3 right = normalize(cross(vec3(0.0, 1.0, 0.0), u_gaze));
  vec3 up = cross(u_gaze, right);
  float t = meet(from - CORNEA_AT * u_gaze, way, CORNEA);
  vec3 at = from + t * way;
  bool cornea = t > 0.0 && dot(at, u_gaze) > LIMBUS;
  vec3 n = normalize(at - CORNEA_AT * u_gaze);
  if (!cornea) {
    t = meet(from, way, SCLERA);
    at = t > 0.0 ? from + t * way : v_position - u_ball;
    n = normalize(at);
  }
  // conjunctiva off the eyeball towards the corners, and the edges of the lids
  float off = cornea ? 0.0 : 0.75 * smoothstep(0.4, 2.2, length(v_position - u_ball) - SCLERA);
  float edge = smoothstep(0.0, 0.3, abs(v_normal.y));
  float inner = 1.0 - smoothstep(0.0, 0.11, v_normal.z);
  float outer = smoothstep(0.9, 1.0, v_normal.z);
  float axis = acos(clamp(dot(normalize(at), u_gaze), -1.0, 1.0));
  float veins = smoothNoise(vec2(atan(dot(at, up), dot(at, right)) * 9.0, axis * 5.0));
  vec3 sclera = mix(vec3(0.54, 0.495, 0.455), vec3(0.50, 0.36, 0.32), 0.30 * veins * smoothstep(0.55, 1.1, axis));
  sclera = mix(sclera, FLESH, max(max(off, inner), 0.6 * outer));
  // the sclera is bluish gray where the cornea begins
  float limbus = 1.0;
  vec3 albedo = sclera * mix(vec3(0.42, 0.44, 0.46), vec3(1.0), smoothstep(-0.1, 0.75, LIMBUS - dot(at, u_gaze)));
  vec3 beside = vec3(0.0);  // from the iris' center to the point that is seen of it
  if (cornea) {
    vec3 bent = refract(way, n, 1.0 / 1.336);
    vec3 iris = at + (IRIS - dot(at, u_gaze)) / min(dot(bent, u_gaze), -0.05) * bent;
    float reach;
    vec3 color = irisColor(iris, right, up, reach);
    beside = iris - IRIS * u_gaze;
    limbus = 1.0 - smoothstep(0.0, 0.28, dot(at, u_gaze) - LIMBUS);
    albedo = mix(color, albedo, limbus);
  }
  vec3 edge_normal = normalize(vec3(0.0, -0.7 * sign(v_normal.y), 0.7));
  albedo = mix(albedo, FLESH, edge);
  vec3 round = normalize(mix(n, vec3(0.0, 0.0, 1.0), 0.6 * off));
  vec3 shading = normalize(mix(mix(u_gaze, round, limbus), edge_normal, edge));
  float lit = litShare(v_position, normalize(round + vec3(0.0, 0.0, 0.6)));
  float below = smoothstep(-0.2, 3.4, v_normal.x);
  float open = mix(mix(0.30, 1.0, below), 0.75, edge) * (1.0 - 0.35 * inner) * (1.0 - 0.3 * outer);
  vec3 eye = -way;
  vec3 wet = normalize(mix(n, edge_normal, edge) + 0.05 * off * (veins - 0.5));
  float alpha = cornea ? 0.05 : mix(0.14, 0.3, max(edge, off));
  float key = p_light_intensity * lit;
  vec3 irradiance = vec3(diffuseFrom(key, u_to_light, shading, beside, below)
    + p_ambient * open * (0.6 + 0.4 * round.y));
  vec3 bright = vec3(highlightFrom(key, u_to_light, wet, eye, alpha));
  for (int i = 0; i < FURTHER; i++) {
    // the rim of the socket shadows the eye from light behind it
    float intensity = furtherIntensity(i, v_position - u_light_center) * smoothstep(-0.25, 0.05, u_further_to[i].z);
    irradiance += diffuseFrom(intensity, u_further_to[i], shading, beside, below);
    bright += highlightFrom(intensity, u_further_to[i], wet, eye, alpha);
  }
  vec3 mirrored = reflect(-eye, wet);
  float base = 1.0 - max(dot(wet, eye), 0.0);
  float reflected = 0.025 + 0.6 * pow(base, 5.0);
  bright += open * p_ambient * reflected * (1.2 + 1.2 * mirrored.y);
#if SURROUNDED
  float a2 = alpha * alpha;
  irradiance += open * environmentIrradiance(shading);
  bright += open * reflected * environmentLight(mirrored, vec3(1.0, exp(-a2), exp(-4.0 * a2)));
#endif
  o_irradiance = vec4(irradiance, v_depth);
  o_albedo = vec4(albedo, 1.0);
  o_specular = vec4(min(bright, 6.0), 0.12);
}
//@chunk eye_inspect_fragment
// Not skin: no texture coordinates, no chromophores.
in float v_depth;
layout(location = 0) out vec4 o_inspect;
layout(location = 1) out vec4 o_normal;
void main() {
  o_inspect = vec4(0.0);
  o_normal = vec4(0.0);
}
