// One face on one canvas: buffers, textures, shadow maps and a picture of a state.
const MODES = { relit: 0, albedo: 1, scanned: 2, light: 3, normals: 4 };
const SHADOW_CELLS = 2048;
const SHOWN_LEVEL = 0.4, SHOWN_PART = 0.8; // sRGB 170 of 255 for four fifths of the face, of its mean albedo
const SAMPLES = 1500;
function bytesOf(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

const bitmapOf = (entry) => createImageBitmap(
  new Blob([bytesOf(entry.data)], { type: entry.type }),
  { colorSpaceConversion: "none", premultiplyAlpha: "none" },
);

function drawnOver(under, over) {
  const canvas = element("canvas", { width: under.width, height: under.height }), context = canvas.getContext("2d");
  for (const picture of [under, over]) context.drawImage(picture, 0, 0);
  return canvas;
}

function programOf(gl, vertexSource, fragmentSource) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error(gl.getShaderInfoLog(shader));
    }
  }
  ["a_position", "a_normal", "a_uv", "a_soft"].forEach((name, i) => gl.bindAttribLocation(program, i, name));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getProgramInfoLog(program));
  }
  const places = new Map();
  return { program, place: (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
    return places.get(name);
  } };
}

// Points and normals of some vertices that face the front.
function vertexSamples(face) {
  const places = new Uint16Array(bytesOf(face.positions).buffer), folded = new Int16Array(bytesOf(face.normals).buffer);
  const samples = [], count = places.length / 3, step = Math.max(1, Math.floor(count / SAMPLES));
  for (let i = 0; i < count; i += step) {
    const x = folded[2 * i] / 32767, y = folded[2 * i + 1] / 32767;
    const z = 1 - Math.abs(x) - Math.abs(y);
    if (z <= 0) continue; // faces away
    const point = face.low.map((low, k) => low + face.span[k] * places[3 * i + k] / 65535);
    samples.push({ point, normal: unit3([x, y, z]) });
  }
  return samples;
}

// The mean over the channels of the soft light on a surface that nothing hides, as the shader has it.
function harmonicLevel(rows, [x, y, z]) {
  const values = [0.28209479, 0.48860251 * y, 0.48860251 * z, 0.48860251 * x, 1.09254843 * x * y, 1.09254843 * y * z,
    0.31539157 * (3 * z * z - 1), 1.09254843 * x * z, 0.54627422 * (x * x - y * y)];
  let sum = 0;
  values.forEach((value, i) => { sum += value * (rows[3 * i] + rows[3 * i + 1] + rows[3 * i + 2]) / 3; });
  return Math.max(sum, 0);
}

class FacePainter {
  static async of(canvas, face, topology) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, powerPreference: "low-power" });
    if (!gl) return null;
    const names = ["albedo", "texture", "gloss", "filled"].filter((name) => face[name]);
    const bitmaps = await Promise.all(names.map((name) => bitmapOf(face[name])));
    return new FacePainter(gl, face, topology, Object.fromEntries(names.map((name, i) => [name, bitmaps[i]])));
  }

  constructor(gl, face, topology, bitmaps) {
    this.gl = gl;
    this.face = face;
    this.main = programOf(gl, FACE_VERTEX_SHADER, FACE_FRAGMENT_SHADER);
    this.depth = programOf(gl, DEPTH_VERTEX_SHADER, DEPTH_FRAGMENT_SHADER);
    this.#upload(topology);
    if (bitmaps.filled) bitmaps.filled = drawnOver(bitmaps.albedo, bitmaps.filled);
    this.textures = ["albedo", "texture", "gloss"].map((name) => this.#texture(bitmaps[name], name !== "gloss"));
    this.filled = face.filled ? this.#texture(bitmaps.filled, true) : this.textures[0];
    this.shadows = { texture: gl.createTexture(), target: gl.createFramebuffer(), layers: 0, key: "" };
    this.center = face.low.map((low, i) => low + face.span[i] / 2);
    this.radius = 0.5 * Math.hypot(...face.span) || 1;
  }

  #upload(topology) {
    const gl = this.gl, face = this.face;
    gl.bindVertexArray(gl.createVertexArray());
    const attributes = [
      [bytesOf(face.positions), 3, gl.UNSIGNED_SHORT], [bytesOf(face.normals), 2, gl.SHORT],
      [bytesOf(topology.uv), 2, gl.UNSIGNED_SHORT],
      face.soft && [bytesOf(face.soft.data), 3, gl.UNSIGNED_SHORT],
    ];
    attributes.forEach((attribute, i) => {
      if (!attribute) return;
      const [data, size, type] = attribute;
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, size, type, true, 0, 0);
    });
    const faces = bytesOf(topology.faces);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    this.corners = faces.length / (topology.wide ? 4 : 2);
    this.cornerType = topology.wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
  }

  #texture(bitmap, colored) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    const format = colored ? gl.SRGB8_ALPHA8 : gl.RGBA8; // decoded before it is filtered
    if (bitmap) {
      gl.texImage2D(gl.TEXTURE_2D, 0, format, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
      bitmap.close?.();
    } else {
      gl.texImage2D(gl.TEXTURE_2D, 0, format, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([255, 255, 255, 255]));
    }
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    const sharper = gl.getExtension("EXT_texture_filter_anisotropic");
    if (sharper) gl.texParameteri(gl.TEXTURE_2D, sharper.TEXTURE_MAX_ANISOTROPY_EXT, 8);
    return texture;
  }

  // What a light sees: all of the face, from where it is or from afar.
  #shadowView(light) {
    const toward = directionOf(light.azimuth, light.elevation), radius = 1.01 * this.radius;
    if (!light.distance) {
      const view = lookAt(along3(this.center, toward, 2 * radius), this.center);
      return { matrix: product4(orthographic(radius, radius, 3 * radius), view), texel: 2 * radius / SHADOW_CELLS };
    }
    const eye = along3([0, 0, 0], toward, light.distance);
    const away = Math.hypot(...minus3(eye, this.center));
    const scale = Math.sqrt(Math.max(away * away - radius * radius, 0.02 * away * away)) / radius;
    const near = Math.max(away - radius, 0.02 * away);
    const view = product4(perspective(scale, scale, near, away + radius), lookAt(eye, this.center));
    return { matrix: view, texel: 2 * away / scale / SHADOW_CELLS };
  }

  #drawShadows(lights) {
    const gl = this.gl, shadows = this.shadows, key = JSON.stringify(lights);
    shadows.views = lights.map((light) => this.#shadowView(light));
    if (shadows.key === key) return;
    shadows.key = key;
    gl.activeTexture(gl.TEXTURE3);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, shadows.texture);
    if (shadows.layers !== Math.max(lights.length, 1)) {
      shadows.layers = Math.max(lights.length, 1);
      gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, gl.DEPTH_COMPONENT24, SHADOW_CELLS, SHADOW_CELLS, shadows.layers, 0,
        gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
      const settings = [["MIN_FILTER", gl.LINEAR], ["MAG_FILTER", gl.LINEAR], ["WRAP_S", gl.CLAMP_TO_EDGE],
        ["WRAP_T", gl.CLAMP_TO_EDGE], ["COMPARE_MODE", gl.COMPARE_REF_TO_TEXTURE], ["COMPARE_FUNC", gl.LEQUAL]];
      for (const [name, value] of settings) gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl[`TEXTURE_${name}`], value);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, shadows.target);
    gl.viewport(0, 0, SHADOW_CELLS, SHADOW_CELLS);
    gl.useProgram(this.depth.program);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1, 2);
    gl.uniform3fv(this.depth.place("u_low"), this.face.low);
    gl.uniform3fv(this.depth.place("u_span"), this.face.span);
    shadows.views.forEach((view, layer) => {
      gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, shadows.texture, 0, layer);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.uniformMatrix4fv(this.depth.place("u_clip_from_model"), false, view.matrix);
      gl.drawElements(gl.TRIANGLES, this.corners, this.cornerType, 0);
    });
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // The camera of applications.default_camera, nearer by a longer focal length.
  #camera(state, width, height) {
    const { middle, radius, depth, distance, margin } = this.face.frame;
    const toward = directionOf(state.view.azimuth, state.view.elevation);
    const eye = along3(middle, toward, distance);
    const focal = state.view.zoom * (Math.min(width, height) - 1) / (2 * margin * radius) * (distance - depth / 2);
    const near = Math.max(distance - 2 * this.radius, 0.01 * distance);
    const lens = perspective(2 * focal / width, 2 * focal / height, near, distance + 2 * this.radius);
    return { eye, matrix: product4(lens, lookAt(eye, middle)) };
  }

  // The factor that suits what is shown: relit as the scan was, or with its brighter parts at SHOWN_LEVEL; albedo
  // as its preview, light below white.
  #shown(state, lights) {
    if (state.mode === "albedo") return this.face.albedoExposure;
    if (state.mode === "relit" && state.autoExposure) return SHOWN_LEVEL / Math.max(this.#brightness(state, lights), 1e-6);
    if (state.mode !== "light") return 1;
    const near = (distance) => distance ? (distance / Math.max(distance - 0.6 * this.face.reach, 0.2 * distance)) ** 2 : 1;
    const brightest = Math.max(0, ...lights.map((light) => light.intensity * near(light.distance)));
    return 0.8 / Math.max((state.harmonic ? 1.5 : state.ambient) + brightest, 1e-3);
  }

  // What a face of its mean albedo shows to the front under some lights: a percentile over its vertices, without
  // cast shadows.
  #brightness(state, lights) {
    this.samples ??= vertexSamples(this.face);
    const levels = this.samples.map(({ point, normal }) => {
      let sum = state.harmonic && this.face.harmonics ? harmonicLevel(this.face.harmonics, normal) : state.ambient;
      for (const light of lights) {
        const ray = minus3(directionOf(light.azimuth, light.elevation), point.map((value) => light.distance ? value / light.distance : 0));
        const square = Math.max(dot3(ray, ray), 1e-6);
        sum += light.intensity * Math.max(dot3(normal, ray), 0) / square ** 1.5;
      }
      return sum;
    }).sort((a, b) => a - b);
    return this.face.albedoLevel * (levels[Math.floor(SHOWN_PART * (levels.length - 1))] ?? 1);
  }

  draw(state) {
    const gl = this.gl, place = this.main.place, face = this.face;
    const lit = state.mode === "relit" || state.mode === "light";
    const lights = lit ? state.lights.filter((light) => light.on && light.intensity > 0).slice(0, MOST_LIGHTS) : [];
    const cast = state.shadows && lights.length > 0;
    if (cast || !this.shadows.layers) this.#drawShadows(cast ? lights : []);
    const { width, height } = gl.canvas, camera = this.#camera(state, width, height);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.main.program);
    const [albedo, ...others] = this.textures;
    [state.assumed && lit ? this.filled : albedo, ...others].forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.activeTexture(gl.TEXTURE3);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.shadows.texture);
    const numbers = {
      u_albedo_scale: 1 / face.albedo.factor, u_gloss_scale: face.gloss ? face.gloss.scale : 1,
      u_roughness: face.reflectance.roughness,
      u_strength: state.assumed || !face.assumedGloss ? face.reflectance.strength : 0,
      u_exponent: face.reflectance.exponent, u_ambient: state.ambient, u_offset: face.shadowOffset,
      u_soft_scale: face.soft ? face.soft.scale : 1,
      u_exposure: 2 ** state.exposure * this.#shown(state, lights),
    };
    const integers = {
      u_mode: MODES[state.mode], u_brdf: face.reflectance.brdf === "minnaert" ? 1 : 0, u_count: lights.length,
      u_albedo: 0, u_texture: 1, u_gloss: 2, u_shadows: 3, u_cast: cast ? 1 : 0,
      u_harmonic: state.harmonic && face.harmonics ? 1 : 0, u_soft_known: face.soft && state.shadows ? 1 : 0,
    };
    for (const [name, value] of Object.entries(numbers)) gl.uniform1f(place(name), value);
    for (const [name, value] of Object.entries(integers)) gl.uniform1i(place(name), value);
    gl.uniform3fv(place("u_eye"), camera.eye);
    gl.uniform3fv(place("u_low"), face.low);
    gl.uniform3fv(place("u_span"), face.span);
    gl.uniform3fv(place("u_harmonics"), face.harmonics || new Float32Array(27));
    gl.uniformMatrix4fv(place("u_clip_from_model"), false, camera.matrix);
    lights.forEach((light, k) => {
      gl.uniform4fv(place(`u_light[${k}]`), [...directionOf(light.azimuth, light.elevation), light.distance ? 1 / light.distance : 0]);
      gl.uniform3fv(place(`u_energy[${k}]`), (light.color || [1, 1, 1]).map((part) => part * light.intensity));
      if (!cast) return;
      gl.uniformMatrix4fv(place(`u_shadow_from_model[${k}]`), false, this.shadows.views[k].matrix);
      gl.uniform1f(place(`u_texel[${k}]`), this.shadows.views[k].texel);
    });
    gl.drawElements(gl.TRIANGLES, this.corners, this.cornerType, 0);
  }

  release() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
