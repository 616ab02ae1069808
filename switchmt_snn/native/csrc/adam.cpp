// Adam (Kingma & Ba 2015, arXiv 1412.6980) on many tensors in one pass over memory, with PyTorch's state; if products
// read a copy of a weight, the pass writes that, too.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "numbers.h"

namespace {

struct Tensor {
    float *parameter, *mean, *square;  // of the gradients, exponential
    const float* gradient;
    float* step;  // number of steps made
    void* copy;   // for products, or null
    long size, copy_is_bf16;   // values; whether the copy is bfloat16
    long channels, positions;  // values [...][channels][positions] have the copy [...][positions][channels]
};

inline Lanes root(Lanes x) {
    Lanes y;
    for (long i = 0; i < WIDTH; i++) y[i] = std::sqrt(x[i]);
    return y;
}

template <class Copy>
void move(const Tensor& t, Copy* copy, long first, long end, double rate, double beta1, double beta2, float epsilon) {
    float step = float(rate / (1.0 - std::pow(beta1, *t.step)));
    float root_correction = float(std::sqrt(1.0 - std::pow(beta2, *t.step)));
    float change = float(1.0 - beta1), change_square = float(1.0 - beta2), keep_square = float(beta2);
    for (long i = first; i < end; i += WIDTH) {
        long width = std::min(WIDTH, end - i);
        Lanes gradient = load(t.gradient + i, width), mean = load(t.mean + i, width);
        mean += (gradient - mean) * change;
        Lanes square = load(t.square + i, width) * keep_square + gradient * gradient * change_square;
        Lanes parameter = load(t.parameter + i, width) - step * mean / (root(square) / root_correction + epsilon);
        store(t.mean + i, mean, width);
        store(t.square + i, square, width);
        store(t.parameter + i, parameter, width);
        if (!copy) continue;
        if (t.positions == 1)
            store(copy + i, parameter, width);
        else
            for (long j = i; j < i + width; j++) {
                long position = j % t.positions, channel = j / t.positions % t.channels;
                put(copy + (j - channel * t.positions - position) + position * t.channels + channel, parameter[j - i]);
            }
    }
}

}  // namespace

// One step for those of `count` tensors that have a gradient.
extern "C" void snn_adam(const Tensor* tensors, long count, double rate, double beta1, double beta2, double epsilon,
                         int threads) {
    constexpr long PART = 1 << 14;
    struct Part {
        long tensor, first;
    };
    std::vector<Part> parts;
    for (long n = 0; n < count; n++) {
        if (!tensors[n].gradient) continue;
        *tensors[n].step += 1.0f;
        for (long first = 0; first < tensors[n].size; first += PART) parts.push_back({n, first});
    }
#pragma omp parallel for schedule(static) num_threads(threads)
    for (size_t i = 0; i < parts.size(); i++) {
        const Tensor& t = tensors[parts[i].tensor];
        long first = parts[i].first, end = std::min(t.size, first + PART);
        if (t.copy_is_bf16)
            move(t, (BFloat16*)t.copy, first, end, rate, beta1, beta2, float(epsilon));
        else
            move(t, (float*)t.copy, first, end, rate, beta1, beta2, float(epsilon));
    }
}
