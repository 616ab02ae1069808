// Input currents y * scale + shift of each channel and T steps of leaky integrate-and-fire neurons on them, in one pass
// over memory, and the gradients of both, in two. The arithmetic is that of neurons.py, step by step.
//
// y [T or 1][R][C], spikes [T][R][C]: rows R (batch times places), channels C innermost. A stride of 0 (y_step, g_step)
// says that every step shares one [R][C]. Sums run over a fixed number of parts, so they do not depend on the threads.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#ifdef __AVX512F__
#include <immintrin.h>
#endif

#include "native_numbers.h"

namespace {

constexpr long PARTS = 64;

struct Neuron {
    float beta, threshold, slope;  // the last one of the surrogate gradient
    int zero, fast_sigmoid;        // reset to zero, else by subtraction; fast sigmoid, else arctangent
};

template <bool FAST_SIGMOID>
inline Lanes surrogate(const Neuron& n, Lanes x) {
    constexpr float half_pi = 1.57079632679489661923f;
    Lanes z = FAST_SIGMOID ? 1.0f + n.slope * (x < 0 ? -x : x) : half_pi * n.slope * x;
    return FAST_SIGMOID ? 1.0f / (z * z) : n.slope / 2 / (1.0f + z * z);
}

// currents [4][C]: scale, shift, center, inverse deviation of y * scale + shift = (y - mean) * a / deviation + b; without
// a mean, scale is a, shift b and the rest 0. Without b, 0.
void make_currents(const float* a, const float* b, const float* mean, const float* variance, float epsilon,
                   float* currents, long channels) {
    for (long c = 0; c < channels; c++) {
        float inverse = mean ? 1.0f / std::sqrt(variance[c] + epsilon) : 0.0f;
        float scale = mean ? a[c] * inverse : a[c], shift = b ? b[c] : 0.0f;
        currents[c] = scale;
        currents[channels + c] = mean ? shift - mean[c] * scale : shift;
        currents[2 * channels + c] = mean ? mean[c] : 0.0f;
        currents[3 * channels + c] = inverse;
    }
}

// visit(t, membranes, which of them fired) for T steps of WIDTH channels of one row, or fewer.
template <bool ZERO, class Y, class F>
inline void integrate(const Neuron& n, const Y* y, long y_step, const float* scale, const float* shift, long steps,
                      long width, F visit) {
    Lanes u = {}, fired = {}, gain = load(scale, width), offset = load(shift, width);
    for (long t = 0; t < steps; t++) {
        Lanes current = load(y + t * y_step, width) * gain + offset;
        u = ZERO ? (u - u * fired) * n.beta + current : (u * n.beta + current) - fired * n.threshold;
        Flags above = u > n.threshold;
        fired = (Lanes)((Flags)same(1.0f) & above);
        visit(t, u, fired, above);
    }
}

// run(first channel, number of them) over all channels; whole blocks have a constant width.
template <class F>
inline void blocks(long channels, F run) {
    long c = 0;
    for (; c + WIDTH <= channels; c += WIDTH) run(c, WIDTH);
    if (c < channels) run(c, channels - c);
}

inline uint32_t bits_of(Flags above) {
#ifdef __AVX512F__
    return _mm512_cmplt_epi32_mask((__m512i)above, _mm512_setzero_si512());
#else
    uint32_t bits = 0;
    for (long i = 0; i < WIDTH; i++) bits |= uint32_t(above[i] & 1) << i;
    return bits;
#endif
}

template <bool ZERO, class Y, class S>
void fire(const Neuron& n, const Y* y, long y_step, const float* scale, const float* shift, S* spikes, long steps,
          long rows, long channels, int threads) {
    long words = (channels + 31) / 32;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long r = 0; r < rows; r++)
        blocks(channels, [&](long c, long width) {
            long at = r * channels + c;
            integrate<ZERO>(n, y + at, y_step, scale + c, shift + c, steps, width,
                            [&](long t, Lanes, Lanes fired, Flags above) {
                                if constexpr (std::is_same_v<S, uint32_t>) {  // lanes beyond the width are no channels
                                    uint32_t bits = bits_of(above) & ((1u << width) - 1);
                                    uint32_t* word = spikes + (t * rows + r) * words + c / 32;
                                    *word = c % 32 ? *word | bits << WIDTH : bits;
                                } else
                                    store(spikes + t * rows * channels + at, fired, width);
                            });
        });
}

// Each neuron's mean spikes over the steps [R][C].
template <bool ZERO, class Y>
void fire_mean(const Neuron& n, const Y* y, long y_step, const float* scale, const float* shift, float* mean, long steps,
               long rows, long channels, int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long r = 0; r < rows; r++)
        blocks(channels, [&](long c, long width) {
            long at = r * channels + c;
            Lanes count = {};
            integrate<ZERO>(n, y + at, y_step, scale + c, shift + c, steps, width,
                            [&](long, Lanes, Lanes fired, Flags) { count += fired; });
            store(mean + at, count / float(steps), width);
        });
}

// The currents' gradient [T or 1][R][C], its sum [C] over steps and rows, and that of its product with y - center.
template <bool ZERO, bool FAST_SIGMOID, class Y, class G>
void unfire(const Neuron& n, const Y* y, long y_step, const float* scale, const float* shift, const float* center,
            const G* grad_spikes, long g_step, float* grad, double* sums, long steps, long rows, long channels,
            int threads) {
    std::vector<float> partial(PARTS * 2 * channels, 0.0f);
#pragma omp parallel num_threads(threads)
    {
        std::vector<Lanes> membranes(steps), spikes(steps);
#pragma omp for schedule(static)
        for (long part = 0; part < PARTS; part++)
            for (long r = rows * part / PARTS; r < rows * (part + 1) / PARTS; r++)
                blocks(channels, [&](long c, long width) {
                    long at = r * channels + c;
                    float *sum = &partial[part * 2 * channels + c], *sum_y = sum + channels;
                    integrate<ZERO>(n, y + at, y_step, scale + c, shift + c, steps, width,
                                    [&](long t, Lanes u, Lanes fired, Flags) { membranes[t] = u, spikes[t] = fired; });
                    Lanes after = {}, total = {}, middle = load(center + c, width), product = load(sum_y, width);
                    for (long t = steps - 1; t >= 0; t--) {
                        Lanes kept = ZERO ? after - after * spikes[t] : after;
                        Lanes slope = surrogate<FAST_SIGMOID>(n, membranes[t] - n.threshold);
                        after = load(grad_spikes + t * g_step + at, width) * slope + kept * n.beta;
                        total += after;
                        if (y_step != 0) {
                            store(grad + t * rows * channels + at, after, width);
                            product += after * (load(y + t * y_step + at, width) - middle);
                        }
                    }
                    if (y_step == 0) {
                        store(grad + at, total, width);
                        product += total * (load(y + at, width) - middle);
                    }
                    store(sum, load(sum, width) + total, width);
                    store(sum_y, product, width);
                });
    }
    for (long part = 0; part < PARTS; part++)
        for (long i = 0; i < 2 * channels; i++) sums[i] += partial[part * 2 * channels + i];
}

// grad * scale + (y - center) * slope + constant.
template <class Y>
void combine(const float* grad, const Y* y, const float* scale, const float* center, const float* slope,
             const float* constant, Y* out, long rows, long channels, int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long r = 0; r < rows; r++)
        for (long c = 0; c < channels; c++) {
            long at = r * channels + c;
            put(out + at, grad[at] * scale[c] + (number(y[at]) - center[c]) * slope[c] + constant[c]);
        }
}

template <class Y>
void moments(const Y* y, float* mean, float* variance, long rows, long channels, int threads) {
    std::vector<float> partial(PARTS * channels);
    for (bool squares : {false, true}) {
        std::fill(partial.begin(), partial.end(), 0.0f);
#pragma omp parallel for schedule(static) num_threads(threads)
        for (long part = 0; part < PARTS; part++) {
            float* sum = &partial[part * channels];
            for (long r = rows * part / PARTS; r < rows * (part + 1) / PARTS; r++)
                for (long c = 0; c < channels; c++) {
                    float x = number(y[r * channels + c]);
                    sum[c] += squares ? (x - mean[c]) * (x - mean[c]) : x;
                }
        }
        for (long c = 0; c < channels; c++) {
            double total = 0;
            for (long part = 0; part < PARTS; part++) total += partial[part * channels + c];
            (squares ? variance : mean)[c] = float(total / double(rows));
        }
    }
}

template <class Y>
void images(const uint8_t* x, float scale, Y* out, long batch, long channels, long places, int threads) {
    constexpr long BLOCK = 64;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long b = 0; b < batch; b++)
        for (long p = 0; p < places; p += BLOCK) {
            const uint8_t* from = x + b * channels * places + p;
            Y* to = out + (b * places + p) * channels;
            auto interleave = [=](long width, long cs) {
                for (long i = 0; i < width; i++)
                    for (long c = 0; c < cs; c++) put(to + i * cs + c, float(from[c * places + i]) * scale);
            };
            if (channels == 4 && places - p >= BLOCK)
                interleave(BLOCK, 4);  // constants, which the compiler makes much of
            else
                interleave(std::min(BLOCK, places - p), channels);
        }
}

// f(...) with the constants and types that a call asks for.
template <class F>
void with_flag(bool flag, F f) {
    flag ? f(std::true_type()) : f(std::false_type());
}

template <class F>
void with_type(bool low, F f) {
    low ? f(BFloat16()) : f(float());
}

template <class F>
void with_types(bool low, bool other_low, F f) {  // all floats, all bfloat16, or floats beside bfloat16 currents
    if (!low) return f(float(), float());
    other_low ? f(BFloat16(), BFloat16()) : f(BFloat16(), float());
}

}  // namespace

extern "C" {

// Spikes of T steps; currents are made for them, and kept for their gradient.
void snn_fire(const Neuron* n, const void* y, int y_low, long y_step, const float* a, const float* b, const float* mean,
              const float* variance, float epsilon, float* currents, void* spikes, int spikes_low, long steps, long rows,
              long channels, int threads) {
    make_currents(a, b, mean, variance, epsilon, currents, channels);
    with_flag(n->zero, [&](auto zero) {
        with_types(y_low, spikes_low, [&](auto y_, auto s_) {
            fire<zero.value>(*n, (const decltype(y_)*)y, y_step, currents, currents + channels, (decltype(s_)*)spikes,
                             steps, rows, channels, threads);
        });
    });
}

// The same spikes as bits: channel c is bit c % 32 of words [T][R][ceil(C / 32)].
void snn_fire_bits(const Neuron* n, const void* y, int y_low, long y_step, const float* a, const float* b,
                   const float* mean, const float* variance, float epsilon, float* currents, void* words, long steps,
                   long rows, long channels, int threads) {
    make_currents(a, b, mean, variance, epsilon, currents, channels);
    with_flag(n->zero, [&](auto zero) {
        with_type(y_low, [&](auto y_) {
            fire<zero.value>(*n, (const decltype(y_)*)y, y_step, currents, currents + channels, (uint32_t*)words, steps,
                             rows, channels, threads);
        });
    });
}

// Their mean over the steps, floats [R][C].
void snn_fire_mean(const Neuron* n, const void* y, int y_low, long y_step, const float* a, const float* b,
                   const float* mean, const float* variance, float epsilon, float* currents, float* spikes, long steps,
                   long rows, long channels, int threads) {
    make_currents(a, b, mean, variance, epsilon, currents, channels);
    with_flag(n->zero, [&](auto zero) {
        with_type(y_low, [&](auto y_) {
            fire_mean<zero.value>(*n, (const decltype(y_)*)y, y_step, currents, currents + channels, spikes, steps, rows,
                                  channels, threads);
        });
    });
}

// Gradients of y, and of a and b (grad_ab [2][C]), from those of the spikes. With an inverse deviation, mean and deviation
// are those of y itself, and follow it. scratch is of y's size.
void snn_unfire(const Neuron* n, const void* y, int y_low, long y_step, const float* currents, const void* grad_spikes,
                int grad_low, long g_step, float* scratch, void* grad_y, float* grad_ab, long steps, long rows,
                long channels, int threads) {
    const float *scale = currents, *shift = scale + channels, *center = shift + channels, *inverse = center + channels;
    std::vector<double> sums(2 * channels, 0.0);
    with_flag(n->zero, [&](auto zero) {
        with_flag(n->fast_sigmoid, [&](auto fast) {
            with_types(y_low, grad_low, [&](auto y_, auto g_) {
                unfire<zero.value, fast.value>(*n, (const decltype(y_)*)y, y_step, scale, shift, center,
                                               (const decltype(g_)*)grad_spikes, g_step, scratch, sums.data(), steps,
                                               rows, channels, threads);
            });
        });
    });
    long all = y_step == 0 ? rows : steps * rows;
    std::vector<float> slope(channels), constant(channels);
    for (long c = 0; c < channels; c++) {
        bool follows = inverse[c] != 0.0f;
        grad_ab[c] = float(sums[channels + c]) * (follows ? inverse[c] : 1.0f);
        grad_ab[channels + c] = float(sums[c]);
        slope[c] = follows ? -scale[c] * inverse[c] * grad_ab[c] / float(all) : 0.0f;
        constant[c] = follows ? -scale[c] * grad_ab[channels + c] / float(all) : 0.0f;
    }
    with_type(y_low, [&](auto y_) {
        using Y = decltype(y_);
        combine(scratch, (const Y*)y, scale, center, slope.data(), constant.data(), (Y*)grad_y, all, channels, threads);
    });
}

// Mean and biased variance of each channel.
void snn_moments(const void* y, int y_low, float* mean, float* variance, long rows, long channels, int threads) {
    with_type(y_low, [&](auto y_) { moments((const decltype(y_)*)y, mean, variance, rows, channels, threads); });
}

// Images [B][C][P] of bytes, P places, times scale, to numbers [B][P][C].
void snn_images(const uint8_t* x, float scale, void* out, int out_low, long batch, long channels, long places,
                int threads) {
    with_type(out_low, [&](auto o_) { images(x, scale, (decltype(o_)*)out, batch, channels, places, threads); });
}
}
