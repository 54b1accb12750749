//@chunk full_vertex
out vec2 v_uv;
void main() {
  v_uv = vec2(float((gl_VertexID << 1) & 2), float(gl_VertexID & 2));
  gl_Position = vec4(2.0 * v_uv - 1.0, 1.0, 1.0);
}
//@chunk mesh_attributes
in vec3 a_position;
in vec3 a_normal;
in vec2 a_uv;
in vec3 a_tangent;
in vec3 a_bitangent;
out vec3 v_position;
out vec3 v_normal;
out vec2 v_uv;
out vec3 v_tangent;
out vec3 v_bitangent;
void passAttributes() {
  v_position = a_position;
  v_normal = a_normal;
  v_uv = a_uv;
  v_tangent = a_tangent;
  v_bitangent = a_bitangent;
}
//@chunk mesh_vertex
uniform mat4 u_view;
uniform mat4 u_projection;
out float v_depth;
void main() {
  passAttributes();
  vec4 seen = u_view * vec4(a_position, 1.0);
  v_depth = -seen.z;
  gl_Position = u_projection * seen;
}
//@chunk uv_vertex
void main() {
  passAttributes();
  gl_Position = vec4(2.0 * a_uv - 1.0, 0.0, 1.0);
}
//@chunk surface_varyings
in vec3 v_position;  // mm, mesh frame
in vec3 v_normal;
in vec2 v_uv;
in vec3 v_tangent;   // change of the point along u, mm
in vec3 v_bitangent; // along v
//@chunk uv_varying
in vec2 v_uv;
