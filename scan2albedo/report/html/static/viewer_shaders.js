// The shaders: the reflectance of lighting/kernels.py and lighting/asrm.py, point by point.
const MOST_LIGHTS = 6;

const FACE_VERTEX_SHADER = `#version 300 es
in vec3 a_position;
in vec2 a_normal;
in vec2 a_uv;
in vec3 a_soft;
uniform mat4 u_clip_from_model;
uniform vec3 u_low, u_span;
out vec3 v_position, v_normal;
out vec2 v_uv;
out vec3 v_soft;

vec3 unfolded(vec2 e) {
  vec3 n = vec3(e, 1.0 - abs(e.x) - abs(e.y));
  if (n.z < 0.0) n.xy = (1.0 - abs(n.yx)) * vec2(n.x >= 0.0 ? 1.0 : -1.0, n.y >= 0.0 ? 1.0 : -1.0);
  return normalize(n);
}

void main() {
  v_position = u_low + u_span * a_position;
  v_normal = unfolded(a_normal);
  v_uv = vec2(a_uv.x, 1.0 - a_uv.y);
  v_soft = a_soft;
  gl_Position = u_clip_from_model * vec4(v_position, 1.0);
}`;

const FACE_FRAGMENT_SHADER = `#version 300 es
precision highp float;
precision highp sampler2DArrayShadow;
in vec3 v_position, v_normal;
in vec2 v_uv;
in vec3 v_soft;
uniform int u_mode, u_brdf, u_count;
uniform vec3 u_eye;
uniform sampler2D u_albedo, u_texture, u_gloss;
uniform float u_albedo_scale, u_gloss_scale, u_roughness, u_strength, u_exponent;
uniform float u_ambient, u_exposure, u_offset, u_soft_scale;
uniform vec4 u_light[${MOST_LIGHTS}];
uniform vec3 u_energy[${MOST_LIGHTS}];
uniform float u_texel[${MOST_LIGHTS}];
uniform mat4 u_shadow_from_model[${MOST_LIGHTS}];
uniform bool u_cast, u_harmonic, u_soft_known;
uniform highp sampler2DArrayShadow u_shadows;
uniform vec3 u_harmonics[9];
out vec4 color;

vec3 encoded(vec3 linear) {
  vec3 c = clamp(linear, 0.0, 1.0);
  return mix(1.055 * pow(max(c, 1e-9), vec3(1.0 / 2.4)) - 0.055, 12.92 * c, vec3(lessThanEqual(c, vec3(0.0031308))));
}

float visible(int k, vec3 normal) {
  if (!u_cast) return 1.0;
  // As the library's rays start off the surface; a map's cells need some more.
  vec4 at = u_shadow_from_model[k] * vec4(v_position + (u_offset + u_texel[k]) * normal, 1.0);
  vec3 p = at.xyz / at.w * 0.5 + 0.5;
  if (any(lessThan(p, vec3(0.0))) || any(greaterThan(p, vec3(1.0)))) return 1.0;
  float cell = 0.5 / float(textureSize(u_shadows, 0).x);
  float sum = 0.0;
  for (int i = 0; i < 4; i++) {
    vec2 aside = cell * vec2(i < 2 ? -1.0 : 1.0, (i & 1) == 0 ? -1.0 : 1.0);
    sum += texture(u_shadows, vec4(p.xy + aside, float(k), p.z));
  }
  return 0.25 * sum;
}

float diffuse_factor(float n_l, float n_v, float l_v) {
  if (u_brdf == 1) return n_l > 0.0 ? pow(n_l, u_roughness) * pow(max(n_v, 1e-4), u_roughness - 1.0) : 0.0;
  float cos_i = max(n_l, 0.0), cos_r = max(n_v, 0.0), variance = u_roughness * u_roughness;
  float a = 1.0 - 0.5 * variance / (variance + 0.33), b = 0.45 * variance / (variance + 0.09);
  float s = max(l_v - cos_i * cos_r, 0.0);
  return cos_i * (a + b * s / max(max(cos_i, cos_r), 1e-4));
}

vec3 harmonic_light(vec3 n) {
  float y[9] = float[9](0.28209479, 0.48860251 * n.y, 0.48860251 * n.z, 0.48860251 * n.x,
    1.09254843 * n.x * n.y, 1.09254843 * n.y * n.z, 0.31539157 * (3.0 * n.z * n.z - 1.0),
    1.09254843 * n.x * n.z, 0.54627422 * (n.x * n.x - n.y * n.y));
  vec3 sum = vec3(0.0);
  for (int i = 0; i < 9; i++) sum += y[i] * u_harmonics[i];
  return max(sum, 0.0);
}

void main() {
  vec3 normal = normalize(v_normal), view = normalize(u_eye - v_position);
  // The inside of an open shell is nothing to see. Smooth normals may face away where the surface does not.
  if (!gl_FrontFacing) { color = vec4(0.0); return; }
  float n_v = max(dot(normal, view), 0.0);
  vec3 albedo = texture(u_albedo, v_uv).rgb * u_albedo_scale;
  if (u_mode == 1) { color = vec4(encoded(u_exposure * albedo), 1.0); return; }
  if (u_mode == 2) { color = vec4(encoded(u_exposure * texture(u_texture, v_uv).rgb), 1.0); return; }
  if (u_mode == 4) { color = vec4(0.5 * normal + 0.5, 1.0); return; }
  vec3 light = vec3(u_ambient);
  if (u_harmonic) light = u_soft_known ? u_soft_scale * v_soft : harmonic_light(normal);
  vec3 specular = vec3(0.0);
  float gloss = u_strength > 0.0 ? u_strength * u_gloss_scale * texture(u_gloss, v_uv).r : 0.0;
  for (int k = 0; k < ${MOST_LIGHTS}; k++) {
    if (k >= u_count) break;
    vec3 ray = u_light[k].xyz - u_light[k].w * v_position;
    float square = max(dot(ray, ray), 1e-12);
    vec3 toward = ray * inversesqrt(square);
    float n_l = dot(normal, toward);
    if (n_l <= 0.0) continue;
    float l_v = dot(toward, view);
    vec3 energy = u_energy[k] / square * visible(k, normal);
    light += energy * diffuse_factor(n_l, n_v, l_v);
    float r_v = min(2.0 * n_l * n_v - l_v, 1.0);
    if (gloss > 0.0 && r_v > 0.0) specular += energy * pow(r_v, u_exponent);
  }
  if (u_mode == 3) { color = vec4(encoded(u_exposure * light), 1.0); return; }
  color = vec4(encoded(u_exposure * (albedo * light + gloss * specular)), 1.0);
}`;

const DEPTH_VERTEX_SHADER = `#version 300 es
in vec3 a_position;
uniform mat4 u_clip_from_model;
uniform vec3 u_low, u_span;
void main() { gl_Position = u_clip_from_model * vec4(u_low + u_span * a_position, 1.0); }`;

const DEPTH_FRAGMENT_SHADER = `#version 300 es
precision mediump float;
void main() {}`;
