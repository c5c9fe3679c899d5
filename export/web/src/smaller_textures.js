// Textures made smaller for WebGL without a graphics card: its drawings are coarse, and the first of them waits for textures
// and for their mipmaps, which the processor makes.

const LARGEST = 1024; // texels a side

/** Gives the materials of a character smaller pictures; compressed ones stay. */
export function shrinkTextures(root) {
  root.traverse((object) => {
    for (const material of [object.material ?? []].flat())
      for (const value of Object.values(material)) if (value?.isTexture && !value.isCompressedTexture) shrink(value);
  });
}

function shrink(texture) {
  const { image } = texture, share = LARGEST / Math.max(image?.width, image?.height);
  if (!(share < 1)) return; // or a picture that never came
  const canvas = new OffscreenCanvas(Math.max(1, Math.round(share * image.width)), Math.max(1, Math.round(share * image.height)));
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  texture.image = canvas;
}
