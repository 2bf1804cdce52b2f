// SPDX-License-Identifier: Apache-2.0
// Depth from one PNG a camera, by a program of sphericalvision-export formats=[compiled] height=...:
//     depth depth.compiled.pt2 depth.png cam1.png cam2.png cam3.png cam4.png
// The result is a panorama: millimetres in 16 bits, 0 where fewer than two cameras look.
#include <png.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include <ATen/core/Tensor.h>
#include <ATen/ops/from_blob.h>
#include <c10/core/InferenceMode.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

struct Picture {
  int64_t height, width;
  std::vector<png_byte> rgb;  // row by row, red, green and blue of each pixel
};

Picture read_png(const std::string& path) {
  png_image image;
  std::memset(&image, 0, sizeof image);
  image.version = PNG_IMAGE_VERSION;
  if (!png_image_begin_read_from_file(&image, path.c_str()))
    throw std::runtime_error(path + ": " + image.message);
  image.format = PNG_FORMAT_RGB;  // grey images, palettes and 16 bits are converted
  Picture picture{image.height, image.width, std::vector<png_byte>(PNG_IMAGE_SIZE(image))};
  if (!png_image_finish_read(&image, nullptr, picture.rgb.data(), 0, nullptr))
    throw std::runtime_error(path + ": " + image.message);
  return picture;
}

void write_png(const std::string& path, const std::vector<png_uint_16>& values, int64_t height, int64_t width) {
  png_image image;
  std::memset(&image, 0, sizeof image);
  image.version = PNG_IMAGE_VERSION;
  image.format = PNG_FORMAT_LINEAR_Y;  // 16 bits, as they are
  image.height = static_cast<png_uint_32>(height);
  image.width = static_cast<png_uint_32>(width);
  if (!png_image_write_to_file(&image, path.c_str(), 0, values.data(), 0, nullptr))
    throw std::runtime_error(path + ": " + image.message);
}

// The images of the cameras in the order of the rig, (1, n, 3, h, w) in [0, 1].
std::vector<float> read_images(const std::vector<std::string>& paths, int64_t& height, int64_t& width) {
  std::vector<float> values;
  for (const std::string& path : paths) {
    const Picture picture = read_png(path);
    if (values.empty()) {
      height = picture.height;
      width = picture.width;
    } else if (picture.height != height || picture.width != width) {
      throw std::runtime_error(path + ": expected " + std::to_string(width) + " x " + std::to_string(height) +
                               " pixels as the first image has, got " + std::to_string(picture.width) + " x " +
                               std::to_string(picture.height));
    }
    for (int channel = 0; channel < 3; ++channel)
      for (size_t pixel = channel; pixel < picture.rgb.size(); pixel += 3)
        values.push_back(picture.rgb[pixel] / 255.0f);
  }
  return values;
}

int main(int argc, char** argv) {
  if (argc < 5) {
    std::fprintf(stderr, "usage: %s PROGRAM.pt2 DEPTH.png IMAGE.png IMAGE.png ...\n", argv[0]);
    return 2;
  }
  try {
    const std::vector<std::string> paths(argv + 3, argv + argc);
    int64_t height = 0, width = 0;
    std::vector<float> values = read_images(paths, height, width);
    const auto cameras = static_cast<int64_t>(paths.size());

    const c10::InferenceMode no_gradients;
    torch::inductor::AOTIModelPackageLoader program(argv[1]);
    const std::vector<at::Tensor> answer =
        program.run({at::from_blob(values.data(), {1, cameras, 3, height, width}, at::kFloat)});

    const at::Tensor inverse_depth = answer.at(0).contiguous(), seen = answer.at(2).contiguous();
    if (inverse_depth.dim() != 3) throw std::runtime_error("the program's answer is no panorama: export it with height=...");
    const float* inverse = inverse_depth.data_ptr<float>();
    const bool* known = seen.data_ptr<bool>();
    std::vector<png_uint_16> millimetres(inverse_depth.numel(), 0);
    float nearest = std::numeric_limits<float>::infinity();
    for (size_t pixel = 0; pixel < millimetres.size(); ++pixel) {
      if (!known[pixel] || !(inverse[pixel] > 0)) continue;
      nearest = std::min(nearest, 1 / inverse[pixel]);
      millimetres[pixel] = static_cast<png_uint_16>(std::lround(std::min(1000 / inverse[pixel], 65535.0f)));
    }
    write_png(argv[2], millimetres, inverse_depth.size(1), inverse_depth.size(2));
    std::printf("%s: %d x %d, nearest %.2f m\n", argv[2], static_cast<int>(inverse_depth.size(2)),
                static_cast<int>(inverse_depth.size(1)), nearest);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
