// three.js's reader of glTF with the decoders of the extensions that a file requires, each loaded only for such a file.

import { TextureLoader } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

/** A loader for this document. */
export async function characterLoader({ extensionsUsed = [] }) {
  const loader = new GLTFLoader();
  // Its own choice fetches pictures from blobs, which the page's policy forbids; an image element may show them.
  loader.register((parser) => ((parser.textureLoader = new TextureLoader(parser.options.manager)), { name: "torchface_pictures_by_elements" }));
  const uses = (name) => extensionsUsed.includes(name);
  if (uses("KHR_draco_mesh_compression")) loader.setDRACOLoader(await (await import("./bundled_decoders.js")).dracoLoader());
  if (uses("KHR_texture_basisu")) loader.setKTX2Loader(await (await import("./bundled_decoders.js")).ktx2Loader());
  if (uses("EXT_meshopt_compression")) {
    const { MeshoptDecoder } = await import("three/addons/libs/meshopt_decoder.module.js");
    await MeshoptDecoder.ready;
    loader.setMeshoptDecoder(MeshoptDecoder);
  }
  return loader;
}
