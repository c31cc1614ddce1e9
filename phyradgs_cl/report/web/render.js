// Draws a volume by rays through a 3D texture (WebGL2), the edges of its box, and points in it.
class VolumeRenderer {
  // voxels: counts [x, y, z], bytes with x fastest, size_mm; points: Float32Array of (x, y, z, weight), or null.
  constructor(canvas, { counts, bytes, size_mm, points }) {
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true }));
    if (!gl || Math.max(...counts) > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) throw new Error("no 3D textures");
    Object.assign(this, { canvas, size_mm, voxel_mm: size_mm.map((size, k) => size / counts[k]) });
    this.reach_mm = 0.505 * Math.hypot(...size_mm);
    this.volume = this.program(SCREEN_VERTEX, VOLUME_FRAGMENT);
    this.marks = this.program(MARK_VERTEX, MARK_FRAGMENT);
    gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, ...counts, 0, gl.RED, gl.UNSIGNED_BYTE, bytes);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) {
      gl.texParameteri(gl.TEXTURE_3D, axis, gl.CLAMP_TO_EDGE);
    }
    for (const use of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, use, gl.LINEAR);
    this.nothing = gl.createVertexArray();
    this.edges = this.array(boxEdges(size_mm));
    this.points = points && this.array(points);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  program(vertex, fragment) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "mark");
    gl.bindAttribLocation(program, 1, "weight");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "no program");
    const places = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  array(values) {
    const { gl } = this, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 16, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 1, gl.FLOAT, false, 16, 12);
    return { array, count: values.length / 4 };
  }

  // Half the width and height of the picture, in mm.
  extent_mm(zoom) {
    const half = this.reach_mm / zoom, ratio = this.canvas.clientWidth / this.canvas.clientHeight;
    return ratio > 1 ? [half * ratio, half] : [half, half / ratio];
  }

  // camera; ends: grey levels 0 to 255 of black and white; threshold: a level, or null for the maximum; points: whether they
  // are shown; share: of the screen's pixels along each side. Returns the milliseconds that drawing took.
  draw({ camera, ends, threshold, points, share }) {
    const { gl, canvas } = this, started = performance.now();
    const density = Math.min(devicePixelRatio, 2) * share;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * density));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * density));
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearDepth(1);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.disable(gl.BLEND);
    const eye = { ...camera.axes(), extent: this.extent_mm(camera.zoom), reach: this.reach_mm };
    const stride = Math.min(...this.voxel_mm) * (share < 0.6 ? 1 : 0.5);
    const black = ends[0] / 255, white = Math.max(ends[1] / 255, black + 1e-3);
    this.use(this.volume, { ...eye, size: this.size_mm, voxel: this.voxel_mm, window: [black, white], stride });
    this.use(this.volume, { threshold: threshold === null ? -1 : Math.max(threshold, 0.5) / 255 });
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.enable(gl.BLEND);
    if (threshold === null) gl.disable(gl.DEPTH_TEST); // a projection has no front
    gl.depthMask(false);
    this.use(this.marks, { ...eye, hue: [0.55, 0.75, 1], point: 1, round_points: 0 });
    this.drawArray(gl.LINES, this.edges);
    const point = Math.max(1, 2 * density * Math.sqrt(camera.zoom));
    this.use(this.marks, { hue: [1, 0.62, 0.2], point, round_points: 1 });
    if (points && this.points) this.drawArray(gl.POINTS, this.points);
    gl.depthMask(true);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits for the picture
    return performance.now() - started;
  }

  drawArray(kind, { array, count }) {
    this.gl.bindVertexArray(array);
    this.gl.drawArrays(kind, 0, count);
  }

  use({ program, places }, values) {
    const { gl } = this;
    gl.useProgram(program);
    for (const [name, value] of Object.entries(values)) {
      if (!(name in places)) continue;
      if (name === "round_points") gl.uniform1i(places[name], value);
      else if (Array.isArray(value)) gl[`uniform${value.length}fv`](places[name], value);
      else gl.uniform1f(places[name], value);
    }
  }
}

// The twelve edges of a box as pairs of (x, y, z, weight); the three that meet at its least corner are the strongest.
function boxEdges(size) {
  const ends = [];
  for (let axis = 0; axis < 3; axis++) {
    for (const corner of [0, 1, 2, 3]) {
      for (const end of [-0.5, 0.5]) {
        const at = [0, 0, 0];
        at[axis] = end * size[axis];
        at[(axis + 1) % 3] = ((corner & 1) - 0.5) * size[(axis + 1) % 3];
        at[(axis + 2) % 3] = ((corner >> 1) - 0.5) * size[(axis + 2) % 3];
        ends.push(...at, corner === 0 ? 0.9 : 0.3);
      }
    }
  }
  return new Float32Array(ends);
}
