// The shaders of the 3D view. Lengths are in mm from the middle of the box; values are grey levels from 0 to 1.
const SCREEN_VERTEX = `#version 300 es
out vec2 place;
void main() {
  place = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0; // one triangle over the whole picture
  gl_Position = vec4(place, 0.0, 1.0);
}`;

const VOLUME_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler3D;
uniform sampler3D volume;
uniform vec3 size, voxel, right, up, towards;
uniform vec2 extent, window; // half the picture's width and height in mm; the grey levels of black and white
uniform float reach, stride, threshold; // a negative threshold: the maximum along each ray
in vec2 place;
out vec4 colour;

float value_at(vec3 at) {
  return texture(volume, at / size + 0.5).r;
}

// Where the ray enters and leaves the box. If it misses the box, the first is larger than the second.
vec2 ends_in_box(vec3 start, vec3 way) {
  vec3 low = (-0.5 * size - start) / way, high = (0.5 * size - start) / way;
  vec3 first = min(low, high), last = max(low, high);
  return vec2(max(max(first.x, first.y), first.z), min(min(last.x, last.y), last.z));
}

vec3 gradient_at(vec3 at) {
  vec3 x = vec3(voxel.x, 0.0, 0.0), y = vec3(0.0, voxel.y, 0.0), z = vec3(0.0, 0.0, voxel.z);
  vec3 rise = vec3(value_at(at + x) - value_at(at - x), value_at(at + y) - value_at(at - y), value_at(at + z) - value_at(at - z));
  return rise / voxel;
}

// The light comes from above the eye's left shoulder; a surface that faces away is lit from both sides.
vec3 shaded(vec3 at, vec3 towards_eye) {
  vec3 rise = gradient_at(at);
  vec3 normal = dot(rise, rise) > 0.0 ? -normalize(rise) : towards_eye;
  vec3 light = normalize(towards - 0.5 * right + 0.7 * up);
  float facing = abs(dot(normal, light)), gloss = pow(abs(dot(normal, normalize(light + towards_eye))), 40.0);
  return vec3(0.93, 0.89, 0.82) * (0.16 + 0.84 * facing) + 0.12 * gloss;
}

void main() {
  vec3 start = place.x * extent.x * right + place.y * extent.y * up + reach * towards;
  vec3 way = -towards + vec3(1e-6); // no component is 0
  vec2 ends = ends_in_box(start, way);
  colour = vec4(0.0, 0.0, 0.0, 1.0);
  gl_FragDepth = 1.0;
  if (ends.x >= ends.y) return;
  float brightest = 0.0, before = ends.x, most = threshold < 0.0 ? window.y : threshold;
  for (float t = ends.x; t < ends.y; t += stride) {
    brightest = max(brightest, value_at(start + t * way));
    if (brightest >= most) {
      if (threshold < 0.0) break; // white already
      float inside = t;
      for (int i = 0; i < 6; i++) { // the crossing, by bisection
        float middle = 0.5 * (before + inside);
        if (value_at(start + middle * way) >= threshold) inside = middle;
        else before = middle;
      }
      colour.rgb = shaded(start + inside * way, towards);
      gl_FragDepth = 0.5 * inside / reach;
      return;
    }
    before = t;
  }
  if (threshold < 0.0) colour.rgb = vec3((brightest - window.x) / (window.y - window.x));
}`;

const MARK_VERTEX = `#version 300 es
uniform vec3 right, up, towards;
uniform vec2 extent;
uniform float reach, point;
in vec3 mark;
in float weight;
out float strength;
void main() {
  strength = weight;
  float depth = (reach - dot(mark, towards)) / reach; // 0 to 2, as the rays count it
  gl_Position = vec4(dot(mark, right) / extent.x, dot(mark, up) / extent.y, depth - 1.0, 1.0);
  gl_PointSize = point;
}`;

const MARK_FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 hue;
uniform bool round_points;
in float strength;
out vec4 colour;
void main() {
  if (round_points && length(gl_PointCoord - 0.5) > 0.5) discard;
  colour = vec4(hue, strength);
}`;
