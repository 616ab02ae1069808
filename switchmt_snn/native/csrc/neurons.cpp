// Input currents y * scale + shift of each channel and T steps of leaky integrate-and-fire neurons on them, in one pass
// over memory, and the gradients of both, in two. The arithmetic is that of neurons.py, step by step.
//
// y [T or 1][R][C], spikes [T][R][C]: rows R (batch times positions), channels C innermost. A stride of 0 (y_step, g_step)
// says that every step shares one [R][C]. Sums run over a fixed number of parts, so they do not depend on the threads.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#ifdef __AVX512F__
#include <immintrin.h>
#endif

#include "numbers.h"

namespace {

constexpr long PARTS = 64;

struct Neuron {
    float beta, threshold, slope;  // the last one of the surrogate gradient
    int resets_to_zero, is_fast_sigmoid;  // else reset by subtraction; else arctangent
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

// visit(t, v, membranes, spikes, which of them fired) for T steps of V vectors of one row's channels; a single vector may
// be shorter. Two are worked on at once because a step waits for the one before it.
template <bool ZERO, int V, class Y, class F>
inline void integrate(Neuron n, const Y* y, long y_step, const float* scale, const float* shift, long steps, long width,
                      F visit) {
    Lanes u[V] = {}, fired[V] = {}, gain[V], offset[V];
    for (int v = 0; v < V; v++) gain[v] = load(scale + v * WIDTH, width), offset[v] = load(shift + v * WIDTH, width);
    for (long t = 0; t < steps; t++)
        for (int v = 0; v < V; v++) {
            Lanes current = load(y + t * y_step + v * WIDTH, width) * gain[v] + offset[v];
            u[v] = ZERO ? (u[v] - u[v] * fired[v]) * n.beta + current : (u[v] * n.beta + current) - fired[v] * n.threshold;
            Flags above = u[v] > n.threshold;
            fired[v] = (Lanes)((Flags)same(1.0f) & above);
            visit(t, v, u[v], fired[v], above);
        }
}

template <int V>
struct Vectors {
    static constexpr int count = V;
};

// run(vectors, first channel, width of each) over all channels; whole vectors have a constant width.
template <class F>
inline void blocks(long channels, F run) {
    long c = 0;
    for (; c + 2 * WIDTH <= channels; c += 2 * WIDTH) run(Vectors<2>(), c, WIDTH);
    for (; c + WIDTH <= channels; c += WIDTH) run(Vectors<1>(), c, WIDTH);
    if (c < channels) run(Vectors<1>(), c, channels - c);
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
void fire(Neuron n, const Y* y, long y_step, const float* scale, const float* shift, S* spikes, long steps, long rows,
          long channels, int threads) {
    long words = (channels + 31) / 32;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long r = 0; r < rows; r++)
        blocks(channels, [=](auto vectors, long c, long width) {
            constexpr int V = decltype(vectors)::count;
            long at = r * channels + c;
            uint32_t bits[V];
            integrate<ZERO, V>(n, y + at, y_step, scale + c, shift + c, steps, width,
                               [&](long t, int v, Lanes, Lanes fired, Flags above) {
                                   if constexpr (!std::is_same_v<S, uint32_t>)
                                       return store(spikes + (t * rows * channels + at) + v * WIDTH, fired, width);
                                   bits[v] = bits_of(above) & ((1u << width) - 1);  // lanes beyond it are no channels
                                   if (v < V - 1) return;
                                   uint32_t* word = (uint32_t*)spikes + (t * rows + r) * words + c / 32;
                                   if (V == 2)
                                       *word = bits[0] | bits[V - 1] << WIDTH;
                                   else
                                       *word = c % 32 ? *word | bits[0] << WIDTH : bits[0];
                               });
        });
}

// Each neuron's mean spikes over the steps [R][C].
template <bool ZERO, class Y>
void fire_mean(Neuron n, const Y* y, long y_step, const float* scale, const float* shift, float* mean, long steps,
               long rows, long channels, int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long r = 0; r < rows; r++)
        blocks(channels, [=](auto vectors, long c, long width) {
            constexpr int V = decltype(vectors)::count;
            long at = r * channels + c;
            Lanes count[V] = {};
            integrate<ZERO, V>(n, y + at, y_step, scale + c, shift + c, steps, width,
                               [&](long, int v, Lanes, Lanes fired, Flags) { count[v] += fired; });
            for (int v = 0; v < V; v++) store(mean + at + v * WIDTH, count[v] / float(steps), width);
        });
}

// The currents' gradient [T or 1][R][C], its sum [C] over steps and rows, and that of its product with y - center.
template <bool ZERO, bool FAST_SIGMOID, class Y, class G>
void fire_backward(Neuron n, const Y* y, long y_step, const float* scale, const float* shift, const float* center,
            const G* grad_spikes, long g_step, float* grad, double* sums, long steps, long rows, long channels,
            int threads) {
    std::vector<float> partial(PARTS * 2 * channels, 0.0f);
    float* sums_of_parts = partial.data();
#pragma omp parallel num_threads(threads)
    {
        std::vector<Lanes> scratch(steps * 4);  // of two vectors, membranes and spikes
        Lanes* saved = scratch.data();
#pragma omp for schedule(static)
        for (long part = 0; part < PARTS; part++)
            for (long r = rows * part / PARTS; r < rows * (part + 1) / PARTS; r++)
                blocks(channels, [=](auto vectors, long c, long width) {
                    constexpr int V = decltype(vectors)::count;
                    long at = r * channels + c;
                    integrate<ZERO, V>(n, y + at, y_step, scale + c, shift + c, steps, width,
                                       [=](long t, int v, Lanes u, Lanes fired, Flags) {
                                           saved[t * 2 * V + v] = u, saved[(t * 2 + 1) * V + v] = fired;
                                       });
                    float *sum = sums_of_parts + part * 2 * channels + c, *sum_y = sum + channels;
                    Lanes grad_u[V] = {}, total[V] = {}, middle[V], product[V];
                    for (int v = 0; v < V; v++)
                        middle[v] = load(center + c + v * WIDTH, width), product[v] = load(sum_y + v * WIDTH, width);
                    for (long t = steps - 1; t >= 0; t--)
                        for (int v = 0; v < V; v++) {
                            Lanes through_reset = ZERO ? grad_u[v] - grad_u[v] * saved[(t * 2 + 1) * V + v] : grad_u[v];
                            Lanes slope = surrogate<FAST_SIGMOID>(n, saved[t * 2 * V + v] - n.threshold);
                            grad_u[v] = load(grad_spikes + t * g_step + at + v * WIDTH, width) * slope + through_reset * n.beta;
                            total[v] += grad_u[v];
                            if (y_step != 0) {
                                store(grad + t * rows * channels + at + v * WIDTH, grad_u[v], width);
                                product[v] += grad_u[v] * (load(y + t * y_step + at + v * WIDTH, width) - middle[v]);
                            }
                        }
                    for (int v = 0; v < V; v++) {
                        long here = v * WIDTH;
                        if (y_step == 0) {
                            store(grad + at + here, total[v], width);
                            product[v] += total[v] * (load(y + at + here, width) - middle[v]);
                        }
                        store(sum + here, load(sum + here, width) + total[v], width);
                        store(sum_y + here, product[v], width);
                    }
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
        blocks(channels, [=](auto vectors, long c, long width) {
            for (int v = 0; v < decltype(vectors)::count; v++, c += WIDTH) {
                long at = r * channels + c;
                Lanes moved = (load(y + at, width) - load(center + c, width)) * load(slope + c, width);
                Lanes x = load(grad + at, width) * load(scale + c, width) + moved + load(constant + c, width);
                store(out + at, x, width);
            }
        });
}

// Mean and biased variance [C], from those of parts (Chan et al., 1979).
template <class Y>
void moments(const Y* y, float* mean, float* variance, long rows, long channels, int threads) {
    std::vector<float> partial(PARTS * 3 * channels);  // means, and sums of differences to them and of their squares
    float* of_parts = partial.data();
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long part = 0; part < PARTS; part++)
        blocks(channels, [=](auto vectors, long c, long width) {
            constexpr int V = decltype(vectors)::count;
            long first = rows * part / PARTS, end = rows * (part + 1) / PARTS;
            Lanes middle[V] = {}, rest[V] = {}, squares[V] = {};
            for (long r = first; r < end; r++)
                for (int v = 0; v < V; v++) middle[v] += load(y + r * channels + c + v * WIDTH, width);
            for (int v = 0; v < V; v++) middle[v] /= float(std::max(end - first, 1L));
            for (long r = first; r < end; r++)
                for (int v = 0; v < V; v++) {
                    Lanes x = load(y + r * channels + c + v * WIDTH, width) - middle[v];
                    rest[v] += x, squares[v] += x * x;
                }
            for (int v = 0; v < V; v++) {
                float* to = of_parts + part * 3 * channels + c + v * WIDTH;
                store(to, middle[v], width), store(to + channels, rest[v], width);
                store(to + 2 * channels, squares[v], width);
            }
        });
    std::vector<double> middle(channels, 0.0), squares(channels, 0.0);
    double count = 0;  // of the parts so far
    for (long part = 0; part < PARTS; part++) {
        double here = double(rows * (part + 1) / PARTS - rows * part / PARTS), both = count + here;
        if (here == 0) continue;
        const float* of_part = of_parts + part * 3 * channels;
        for (long c = 0; c < channels; c++) {
            double rest = of_part[channels + c] / here, away = of_part[c] + rest - middle[c];
            squares[c] += of_part[2 * channels + c] - rest * rest * here + away * away * (count * here / both);
            middle[c] += away * (here / both);
        }
        count = both;
    }
    for (long c = 0; c < channels; c++) mean[c] = float(middle[c]), variance[c] = float(squares[c] / count);
}

template <class Y>
void scale_images(const uint8_t* x, float scale, Y* out, long batch, long channels, long positions, int threads) {
    constexpr long BLOCK = 64;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long b = 0; b < batch; b++)
        for (long p = 0; p < positions; p += BLOCK) {
            const uint8_t* from = x + b * channels * positions + p;
            Y* to = out + (b * positions + p) * channels;
            auto interleave = [=](long width, long cs) {
                for (long i = 0; i < width; i++)
                    for (long c = 0; c < cs; c++) put(to + i * cs + c, float(from[c * positions + i]) * scale);
            };
            if (channels == 4 && positions - p >= BLOCK)
                interleave(BLOCK, 4);  // constants, which the compiler makes much of
            else
                interleave(std::min(BLOCK, positions - p), channels);
        }
}

// [images][channels][positions] to [images][positions][channels].
template <class X>
void channels_last(const X* x, X* out, long images, long channels, long positions, int threads) {
    constexpr long BLOCK = 32;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long i = 0; i < images; i++)
        for (long c = 0; c < channels; c += BLOCK) {
            auto turn = [=](long width) {
                const X* from = x + (i * channels + c) * positions;
                X* to = out + i * positions * channels + c;
                for (long p = 0; p < positions; p++, to += channels)
                    for (long j = 0; j < width; j++) to[j] = from[j * positions + p];
            };
            channels - c >= BLOCK ? turn(BLOCK) : turn(channels - c);
        }
}

// f(...) with the constants and types that a call asks for.
template <class F>
void with_flag(bool flag, F f) {
    flag ? f(std::true_type()) : f(std::false_type());
}

template <class F>
void with_type(bool is_bf16, F f) {
    is_bf16 ? f(BFloat16()) : f(float());
}

template <class F>
void with_types(bool is_bf16, bool other_is_bf16, F f) {  // all floats, all bfloat16, or floats with bfloat16 currents
    if (!is_bf16) return f(float(), float());
    other_is_bf16 ? f(BFloat16(), BFloat16()) : f(BFloat16(), float());
}

}  // namespace

extern "C" {

// Spikes of T steps; currents are made for them, and kept for their gradient.
void snn_fire(const Neuron* n, const void* y, int y_is_bf16, long y_step, const float* a, const float* b, const float* mean,
              const float* variance, float epsilon, float* currents, void* spikes, int spikes_are_bf16, long steps, long rows,
              long channels, int threads) {
    make_currents(a, b, mean, variance, epsilon, currents, channels);
    with_flag(n->resets_to_zero, [&](auto zero) {
        with_types(y_is_bf16, spikes_are_bf16, [&](auto y_, auto s_) {
            fire<zero.value>(*n, (const decltype(y_)*)y, y_step, currents, currents + channels, (decltype(s_)*)spikes,
                             steps, rows, channels, threads);
        });
    });
}

// The same spikes as bits: channel c is bit c % 32 of words [T][R][ceil(C / 32)].
void snn_fire_bits(const Neuron* n, const void* y, int y_is_bf16, long y_step, const float* a, const float* b,
                   const float* mean, const float* variance, float epsilon, float* currents, void* words, long steps,
                   long rows, long channels, int threads) {
    make_currents(a, b, mean, variance, epsilon, currents, channels);
    with_flag(n->resets_to_zero, [&](auto zero) {
        with_type(y_is_bf16, [&](auto y_) {
            fire<zero.value>(*n, (const decltype(y_)*)y, y_step, currents, currents + channels, (uint32_t*)words, steps,
                             rows, channels, threads);
        });
    });
}

// Their mean over the steps, floats [R][C].
void snn_fire_mean(const Neuron* n, const void* y, int y_is_bf16, long y_step, const float* a, const float* b,
                   const float* mean, const float* variance, float epsilon, float* currents, float* spikes, long steps,
                   long rows, long channels, int threads) {
    make_currents(a, b, mean, variance, epsilon, currents, channels);
    with_flag(n->resets_to_zero, [&](auto zero) {
        with_type(y_is_bf16, [&](auto y_) {
            fire_mean<zero.value>(*n, (const decltype(y_)*)y, y_step, currents, currents + channels, spikes, steps, rows,
                                  channels, threads);
        });
    });
}

// Gradients of y, and of a and b (grad_ab [2][C]), from those of the spikes. With an inverse deviation, mean and deviation
// are those of y itself, and follow it. scratch is of y's size.
void snn_fire_backward(const Neuron* n, const void* y, int y_is_bf16, long y_step, const float* currents, const void* grad_spikes,
                int grad_is_bf16, long g_step, float* scratch, void* grad_y, float* grad_ab, long steps, long rows,
                long channels, int threads) {
    const float *scale = currents, *shift = scale + channels, *center = shift + channels, *inverse = center + channels;
    std::vector<double> sums(2 * channels, 0.0);
    with_flag(n->resets_to_zero, [&](auto zero) {
        with_flag(n->is_fast_sigmoid, [&](auto fast) {
            with_types(y_is_bf16, grad_is_bf16, [&](auto y_, auto g_) {
                fire_backward<zero.value, fast.value>(*n, (const decltype(y_)*)y, y_step, scale, shift, center,
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
    with_type(y_is_bf16, [&](auto y_) {
        using Y = decltype(y_);
        combine(scratch, (const Y*)y, scale, center, slope.data(), constant.data(), (Y*)grad_y, all, channels, threads);
    });
}

// Mean and biased variance of each channel; a running mean and unbiased variance, if there are any, move towards them.
void snn_moments(const void* y, int y_is_bf16, float* mean, float* variance, float* running_mean, float* running_variance,
                 float momentum, long rows, long channels, int threads) {
    with_type(y_is_bf16, [&](auto y_) { moments((const decltype(y_)*)y, mean, variance, rows, channels, threads); });
    if (!running_mean) return;
    float unbiased = float(double(rows) / double(rows - 1));
    for (long c = 0; c < channels; c++) {
        running_mean[c] += momentum * (mean[c] - running_mean[c]);
        running_variance[c] += momentum * (variance[c] * unbiased - running_variance[c]);
    }
}

// Images [B][C][P] of bytes, P positions, times scale, to values [B][P][C].
void snn_scale_images(const uint8_t* x, float scale, void* out, int out_is_bf16, long batch, long channels, long positions,
                int threads) {
    with_type(out_is_bf16, [&](auto o_) { scale_images(x, scale, (decltype(o_)*)out, batch, channels, positions, threads); });
}

void snn_channels_last(const void* x, int is_bf16, void* out, long images, long channels, long positions, int threads) {
    with_type(is_bf16, [&](auto x_) {
        using X = decltype(x_);
        channels_last((const X*)x, (X*)out, images, channels, positions, threads);
    });
}
}
