"""The shader of export/README.md in a real browser mixes wrinkle maps as ``RegionMaps.blend`` does."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.geometry.meshes.normal_maps import decode_normals, encode_normals
from torchface.geometry.meshes.region_maps import RegionMaps

README = Path(__file__).resolve().parents[2] / "export" / "README.md"
HEIGHT, WIDTH, REGIONS, MAPS = 12, 20, 5, 2
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--no-first-run", "--disable-dev-shm-usage", "--dump-dom")  # fmt: skip
PAGE = """<canvas id="c" width="WIDTH" height="HEIGHT"></canvas><pre id="told"></pre><script>
const given = GIVEN, [w, h] = [WIDTH, HEIGHT];
const gl = document.getElementById("c").getContext("webgl2", { preserveDrawingBuffer: true });
const program = gl.createProgram();
for (const [kind, code] of [[gl.VERTEX_SHADER, given.vertex], [gl.FRAGMENT_SHADER, given.fragment]]) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, code); gl.compileShader(shader); gl.attachShader(program, shader);
}
gl.linkProgram(program); gl.useProgram(program); gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
Object.entries(given.textures).forEach(([name, layers], unit) => {
  const kind = name === "restingNormals" ? gl.TEXTURE_2D : gl.TEXTURE_2D_ARRAY, bytes = new Uint8Array(layers.flat());
  gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(kind, gl.createTexture());
  if (kind === gl.TEXTURE_2D) gl.texImage2D(kind, 0, gl.RGB8, w, h, 0, gl.RGB, gl.UNSIGNED_BYTE, bytes);
  else gl.texImage3D(kind, 0, gl.RGB8, w, h, layers.length, 0, gl.RGB, gl.UNSIGNED_BYTE, bytes);
  gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST); gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.uniform1i(gl.getUniformLocation(program, name), unit);
});
gl.uniform1fv(gl.getUniformLocation(program, "mapWeights"), given.weights);
gl.drawArrays(gl.TRIANGLES, 0, 3);
const seen = new Uint8Array(4 * w * h);
gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, seen);
const told = { log: gl.getProgramInfoLog(program), error: gl.getError(), pixels: Array.from(seen) };
document.getElementById("told").textContent = JSON.stringify(told);
</script>"""
VERTEX = """#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }"""


def texels(images: Tensor) -> list[list[int]]:
    """Images (L,3,H,W) in [0,1] as layers of bytes."""
    return images.mul(255).round().int().permute(0, 2, 3, 1).flatten(1).tolist()


def some_images(count: int, seed: int) -> Tensor:
    """Normal maps as files hold them, (count,3,H,W), of 8 bits."""
    vectors = 0.4 * torch.randn(count, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))
    vectors[:, 2] = vectors[:, 2].abs() + 0.6
    return encode_normals(torch.nn.functional.normalize(vectors, dim=1)).mul(255).round() / 255


@pytest.mark.browser
def test_the_shader_mixes_as_the_library_does(tmp_path: Path) -> None:
    browser = next((found for name in ("chromium", "google-chrome") if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("no Chromium is installed (apt-get install chromium)")
    (code,) = re.findall(r"```glsl\n(.*?)```", README.read_text(), re.DOTALL)
    rest, normals = some_images(1, 0), some_images(MAPS, 1)
    generator = torch.Generator().manual_seed(2)
    masks = torch.rand(6, HEIGHT, WIDTH, generator=generator).mul(255).round() / 255
    weights = torch.rand(REGIONS, MAPS, generator=generator) * 0.6
    names = [str(i) for i in range(REGIONS)]
    decoded = torch.stack([decode_normals(one) for one in (*rest, *normals)])
    maps = RegionMaps(tuple(names), decoded[1:], torch.zeros(MAPS, HEIGHT, WIDTH), masks[:REGIONS], decoded[0])
    expected = encode_normals(maps.blend(weights)[0])
    fragment = f"""#version 300 es
        precision highp float;
        #define REGIONS {REGIONS}
        #define MAPS {MAPS}
        {code}
        out vec4 color;
        void main() {{ color = vec4(wrinkledNormal(gl_FragCoord.xy / vec2({WIDTH}, {HEIGHT})) * 0.5 + 0.5, 1.0); }}"""
    given = {
        "vertex": VERTEX,
        "fragment": fragment,
        "weights": weights.flatten().tolist(),
        "textures": {
            "restingNormals": texels(rest),
            "wrinkleNormals": texels(normals),
            "regionMasks": texels(masks.view(2, 3, HEIGHT, WIDTH)),
        },
    }
    page = PAGE.replace("GIVEN", json.dumps(given)).replace("WIDTH", str(WIDTH)).replace("HEIGHT", str(HEIGHT))
    (tmp_path / "page.html").write_text(page)
    place = ["--user-data-dir=" + str(tmp_path / "profile"), (tmp_path / "page.html").as_uri()]
    shown = subprocess.run([browser, *FLAGS, *place], capture_output=True, text=True, timeout=120, check=True).stdout
    told = json.loads(re.findall(r'<pre id="told">(.*?)</pre>', shown, re.DOTALL)[0].replace("&quot;", '"'))
    assert not told["error"], told["log"]
    seen = torch.tensor(told["pixels"]).view(HEIGHT, WIDTH, 4)[..., :3].permute(2, 0, 1) / 255
    torch.testing.assert_close(seen, expected, atol=1.5 / 255, rtol=0)
    assert (expected - rest[0]).abs().max() > 0.1
