// Products of bfloat16 values with sums in single precision (AVX512-BF16). One instruction multiplies pairs of values and
// adds both products to a sum, so one factor is packed with the two values of a pair side by side, and of the other one
// a pair is repeated in all lanes. Images have their channels innermost.
//
// Every sum has one order, so it does not depend on the threads.

#include <algorithm>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "numbers.h"

extern "C" int snn_has_bfloat16() {
#ifdef __AVX512BF16__
    return 1;
#else
    return 0;
#endif
}

#ifdef __AVX512BF16__
#include <immintrin.h>

namespace {

constexpr long LARGEST = 12;  // places whose sums fit into the registers
constexpr long CHANNELS = 32;  // that are summed together
constexpr long PAIR = 2 * CHANNELS;

// Sums over rows of pairs, for `count` places and CHANNELS channels.
struct Tile {
    const BFloat16* from;     // of place 0
    long place, row, pair;    // how far the next ones are
    const BFloat16* weights;  // [rows][pairs][CHANNELS][2]
    long rows, pairs;

    template <int COUNT, class Put>
    void sum(__m512 low, __m512 high, Put put) const {
        __m512 lows[COUNT], highs[COUNT];
        for (int i = 0; i < COUNT; i++) lows[i] = low, highs[i] = high;
        const BFloat16* w = weights;
        for (long r = 0; r < rows; r++)
            for (long p = 0; p < pairs; p++, w += PAIR) {
                __m512bh w_low = (__m512bh)_mm512_loadu_si512(w), w_high = (__m512bh)_mm512_loadu_si512(w + CHANNELS);
                const BFloat16* x = from + r * row + p * pair;
                for (int i = 0; i < COUNT; i++) {
                    __m512bh repeated = repeat(x + i * place);
                    lows[i] = _mm512_dpbf16_ps(lows[i], w_low, repeated);
                    highs[i] = _mm512_dpbf16_ps(highs[i], w_high, repeated);
                }
            }
        for (int i = 0; i < COUNT; i++) put(i, lows[i], highs[i]);
    }

    template <class Put, int COUNT = LARGEST>
    void sum_of(long count, __m512 low, __m512 high, Put put) const {
        if constexpr (COUNT > 0) {
            if (count == COUNT)
                sum<COUNT>(low, high, put);
            else
                sum_of<Put, COUNT - 1>(count, low, high, put);
        }
    }

    // As sum_of(LARGEST or fewer), for a whole line whose ends are padded: of the TAPS blocks of a row's pairs, block k is
    // left out where it sees nothing but padding, at the first TAPS - 1 - k and the last k places.
    template <int TAPS, class Put, int COUNT = LARGEST>
    void line(long count, Put put) const {
        if constexpr (COUNT >= TAPS) {
            if (count != COUNT) return line<TAPS, Put, COUNT - 1>(count, put);
            __m512 lows[COUNT], highs[COUNT];
            for (int i = 0; i < COUNT; i++) lows[i] = highs[i] = _mm512_setzero_ps();
            const BFloat16* w = weights;
            for (long r = 0; r < rows; r++)
                blocks(std::make_integer_sequence<int, TAPS>(), [&](auto k) {
                    constexpr int first = TAPS - 1 - decltype(k)::value, end = COUNT - decltype(k)::value;
                    const BFloat16* x = from + r * row + decltype(k)::value * (pairs / TAPS) * pair;
                    for (long p = 0; p < pairs / TAPS; p++, w += PAIR, x += pair) {
                        __m512bh w_low = (__m512bh)_mm512_loadu_si512(w);
                        __m512bh w_high = (__m512bh)_mm512_loadu_si512(w + CHANNELS);
                        for (int i = first; i < end; i++) {
                            __m512bh repeated = repeat(x + i * place);
                            lows[i] = _mm512_dpbf16_ps(lows[i], w_low, repeated);
                            highs[i] = _mm512_dpbf16_ps(highs[i], w_high, repeated);
                        }
                    }
                });
            for (int i = 0; i < COUNT; i++) put(i, lows[i], highs[i]);
        }
    }

    template <int... K, class Block>
    static void blocks(std::integer_sequence<int, K...>, Block block) {
        (block(std::integral_constant<int, K>()), ...);
    }

    static __m512bh repeat(const BFloat16* pair) {
        int32_t both;
        std::memcpy(&both, pair, 4);
        return (__m512bh)_mm512_set1_epi32(both);
    }

    static auto rounded(BFloat16* to, long to_place) {
        return [=](int i, __m512 a, __m512 b) {
            _mm512_storeu_si512(to + i * to_place, (__m512i)_mm512_cvtne2ps_pbh(b, a));
        };
    }

    // Rounded, to places of their own, from a bias on.
    void put(long count, const float* bias, BFloat16* to, long to_place) const {
        __m512 low = bias ? _mm512_loadu_ps(bias) : _mm512_setzero_ps();
        __m512 high = bias ? _mm512_loadu_ps(bias + 16) : _mm512_setzero_ps();
        sum_of(count, low, high, rounded(to, to_place));
    }

    // The same for a line (see there) without a bias; false for what it has no code for.
    bool put_line(long count, long taps, BFloat16* to, long to_place) const {
        if (count < taps || taps < 2 || taps > 3) return false;
        taps == 2 ? line<2>(count, rounded(to, to_place)) : line<3>(count, rounded(to, to_place));
        return true;
    }

    // Added to sums [count][CHANNELS].
    void add(long count, float* sums) const {
        sum_of(count, _mm512_setzero_ps(), _mm512_setzero_ps(), [=](int i, __m512 a, __m512 b) {
            float* to = sums + i * CHANNELS;
            _mm512_storeu_ps(to, _mm512_add_ps(_mm512_loadu_ps(to), a));
            _mm512_storeu_ps(to + 16, _mm512_add_ps(_mm512_loadu_ps(to + 16), b));
        });
    }
};

// Calls with (first, count) for parts of `all` places.
template <class Part>
void in_parts(long all, Part part) {
    long parts = (all + LARGEST - 1) / LARGEST;
    for (long i = 0; i < parts; i++) part(all * i / parts, all * (i + 1) / parts - all * i / parts);
}

// [CHANNELS][2] from two rows of CHANNELS.
inline void pack(const BFloat16* first, const BFloat16* second, BFloat16* to) {
    alignas(64) static constexpr uint16_t LOW[32] = {0, 32, 1, 33, 2,  34, 3,  35, 4,  36, 5,  37, 6,  38, 7,  39,
                                                     8, 40, 9, 41, 10, 42, 11, 43, 12, 44, 13, 45, 14, 46, 15, 47};
    __m512i low = _mm512_load_si512(LOW), high = _mm512_add_epi16(low, _mm512_set1_epi16(16));
    __m512i a = _mm512_loadu_si512(first), b = _mm512_loadu_si512(second);
    _mm512_storeu_si512(to, _mm512_permutex2var_epi16(a, low, b));
    _mm512_storeu_si512(to + CHANNELS, _mm512_permutex2var_epi16(a, high, b));
}

}  // namespace

extern "C" {

// y [images][h][w][O] = x [images][height][width][C] * weights [O][kernel][kernel][C] + bias [O], O being a multiple of
// CHANNELS and kernel * C even.
void snn_convolve(const BFloat16* x, const BFloat16* weights, const float* bias, BFloat16* y, long images, long height,
                  long width, long C, long O, long kernel, long stride, int threads) {
    long down = (height - kernel) / stride + 1, across = (width - kernel) / stride + 1;
    long blocks = O / CHANNELS, size = kernel * kernel * C, row = width * C;
    std::vector<BFloat16> packed(O * size);
    for (long o = 0; o < O; o++)
        for (long k = 0; k < size; k++)
            packed[((o / CHANNELS * size + k) / 2 * CHANNELS + o % CHANNELS) * 2 + k % 2] = weights[o * size + k];
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long image = 0; image < images; image++)
        for (long block = 0; block < blocks; block++)
            for (long i = 0; i < down; i++)
                in_parts(across, [&](long j, long count) {
                    Tile tile = {x + (image * height + i * stride) * row + j * stride * C, stride * C, row, 2,
                                 packed.data() + block * size * CHANNELS, kernel, kernel * C / 2};
                    tile.put(count, bias + block * CHANNELS, y + ((image * down + i) * across + j) * O + block * CHANNELS,
                             O);
                });
}

// The gradient of a convolution's input. Inputs whose coordinates have the same remainders by the stride (a phase) see a
// convolution of the outputs' gradient with stride 1 and kernel / stride taps.
// grad_x [images][height * stride][width * stride][C] from grad_y [images][height - taps + 1][width - taps + 1][O] and
// weights [O][taps * stride][taps * stride][C]; O is even, C a multiple of CHANNELS.
void snn_convolve_input_gradient(const BFloat16* grad_y, const BFloat16* weights, BFloat16* grad_x, long images, long height,
                        long width, long O, long C, long taps, long stride, int threads) {
    long blocks = C / CHANNELS, phases = stride * stride, kernel = taps * stride, row_pairs = taps * O / 2;
    long down = height - taps + 1, across = width - taps + 1, row = (width + taps - 1) * O;
    std::vector<BFloat16> packed(phases * blocks * taps * row_pairs * PAIR);
    for (long part = 0; part < phases * blocks * taps; part++) {
        long ky = (taps - 1 - part % taps) * stride, block = part / taps % blocks, phase = part / taps / blocks;
        for (long p = 0; p < row_pairs; p++) {
            long kx = (taps - 1 - p * 2 / O) * stride + phase % stride, o = p * 2 % O;
            const BFloat16* from = weights + ((o * kernel + ky + phase / stride) * kernel + kx) * C + block * CHANNELS;
            pack(from, from + kernel * kernel * C, packed.data() + (part * row_pairs + p) * PAIR);
        }
    }
#pragma omp parallel num_threads(threads)
    {
        std::vector<BFloat16> padded(down * row);  // by taps - 1 zeros at both sides
#pragma omp for schedule(static)
        for (long image = 0; image < images; image++) {
            for (long i = 0; i < down; i++)
                std::copy_n(grad_y + (image * down + i) * across * O, across * O,
                            padded.data() + i * row + (taps - 1) * O);
            for (long part = 0; part < phases * blocks; part++)
                for (long i = 0; i < height; i++)
                    in_parts(width, [&](long j, long count) {
                        long block = part % blocks, phase = part / blocks, above = std::max(0L, taps - 1 - i);
                        long y = i * stride + phase / stride, x = j * stride + phase % stride;
                        Tile tile = {padded.data() + (i + above - taps + 1) * row + j * O, O, row, 2,
                                     packed.data() + (part * taps + above) * row_pairs * PAIR,
                                     std::min(taps, down + taps - 1 - i) - above, row_pairs};
                        BFloat16* to = grad_x + ((image * height * stride + y) * width * stride + x) * C;
                        if (count < width || !tile.put_line(count, taps, to + block * CHANNELS, stride * C))
                            tile.put(count, nullptr, to + block * CHANNELS, stride * C);
                    });
        }
    }
}

// Gradients of a convolution's weights [O][kernel][kernel][C] and bias [O] from x [images][height][width][C] and grad_y
// [images][h][w][O], O being a multiple of CHANNELS. A pair are two windows side by side;
// the last of an odd number has zeros beside it, so inputs are finite.
void snn_convolve_weight_gradient(const BFloat16* x, const BFloat16* grad_y, float* grad_weights, float* grad_bias, long images,
                         long height, long width, long C, long O, long kernel, long stride, int threads) {
    long down = (height - kernel) / stride + 1, across = (width - kernel) / stride + 1, window_pairs = (across + 1) / 2;
    long blocks = O / CHANNELS, depth = kernel * C, step = stride * C, size = kernel * depth;
    long row = (width * C + CHANNELS - 1) / CHANNELS * PAIR;
    long groups = std::min(images, 16L);  // summed apart
    long all = (size + 1) * O;
    std::unique_ptr<float[]> sums(new float[groups * all]);  // [group][block][kernel row, its inputs; bias][CHANNELS]
#pragma omp parallel num_threads(threads)
    {
        std::vector<BFloat16> line(row / 2 + step + CHANNELS);
        std::vector<BFloat16> inputs(height * row);                     // [height][width * C][2]
        std::vector<BFloat16> outputs(down * window_pairs * PAIR);      // [h][pair][CHANNELS][2]
        const BFloat16 zeros[CHANNELS] = {};
#pragma omp for schedule(static)
        for (long group = 0; group < groups; group++) {
            std::fill_n(sums.get() + group * all, all, 0.0f);
            for (long image = images * group / groups; image < images * (group + 1) / groups; image++) {
                for (long i = 0; i < height; i++) {
                    std::copy_n(x + (image * height + i) * width * C, width * C, line.data());
                    for (long k = 0; k < row / 2; k += CHANNELS)
                        pack(line.data() + k, line.data() + k + step, inputs.data() + i * row + k * 2);
                }
                for (long block = 0; block < blocks; block++) {
                    float* to = sums.get() + group * all + block * (size + 1) * CHANNELS;
                    Lanes low = load(to + size * CHANNELS, WIDTH), high = load(to + size * CHANNELS + WIDTH, WIDTH);
                    for (long i = 0; i < down; i++)
                        for (long j = 0; j < across; j += 2) {
                            const BFloat16* first = grad_y + ((image * down + i) * across + j) * O + block * CHANNELS;
                            const BFloat16* second = j + 1 < across ? first + O : zeros;
                            low += load(first, WIDTH) + load(second, WIDTH);
                            high += load(first + WIDTH, WIDTH) + load(second + WIDTH, WIDTH);
                            pack(first, second, outputs.data() + (i * window_pairs + j / 2) * PAIR);
                        }
                    store(to + size * CHANNELS, low, WIDTH), store(to + size * CHANNELS + WIDTH, high, WIDTH);
                    for (long ky = 0; ky < kernel; ky++)
                        in_parts(depth, [&](long k, long count) {
                            Tile tile = {inputs.data() + ky * row + k * 2, 2, stride * row, 4 * step, outputs.data(),
                                         down, window_pairs};
                            tile.add(count, to + (ky * depth + k) * CHANNELS);
                        });
                }
            }
        }
#pragma omp for schedule(static)
        for (long k = 0; k <= size; k++)
            for (long o = 0; o < O; o += WIDTH) {
                const float* from = sums.get() + (o / CHANNELS * (size + 1) + k) * CHANNELS + o % CHANNELS;
                Lanes sum = {};
                for (long group = 0; group < groups; group++) sum += load(from + group * all, WIDTH);
                for (long i = 0; i < WIDTH; i++)
                    (k < size ? grad_weights[(o + i) * size + k] : grad_bias[o + i]) = sum[i];
            }
    }
}

// out [M][N] = a [M][K] . b [K][N]; K is even, N a multiple of CHANNELS.
void snn_matrix_product(const BFloat16* a, const BFloat16* b, BFloat16* out, long M, long K, long N, int threads) {
#pragma omp parallel num_threads(threads)
    {
        std::vector<BFloat16> packed(K * CHANNELS);
#pragma omp for schedule(static)
        for (long n = 0; n < N; n += CHANNELS) {
            for (long k = 0; k < K; k += 2) pack(b + k * N + n, b + (k + 1) * N + n, packed.data() + k * CHANNELS);
            in_parts(M, [&](long m, long count) {
                // The next columns, while these are worked on: each row's part lies in another page.
                if (n + CHANNELS < N)
                    for (long k = K * m / M; k < K * (m + count) / M; k++) __builtin_prefetch(b + k * N + n + CHANNELS);
                Tile{a + m * K, K, 0, 2, packed.data(), 1, K / 2}.put(count, nullptr, out + m * N + n, N);
            });
        }
    }
}
}
#endif
