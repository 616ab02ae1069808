// Products of a matrix of weights and a matrix of spikes, a spike being one bit. For four inputs, the sixteen sums that
// their weights can have lie in one register, and four bits choose one of them: the method of the four Russians (Arlazarov
// et al., 1970) with a permutation as its table. One permutation is 64 products, in single precision and without
// rounding them; a fused multiply-add is 16.
//
// Spikes [N lanes][K bits] lie in panels of 64 lanes: bit k of lane n is bit k % 32 of
// panels[(n / 64 * words + k / 32) * 64 + n % 64], words = ceil(K / 32). Bits and lanes beyond K and N are 0.
// Every sum has one order, so it does not depend on the threads.

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <vector>

#include "numbers.h"

extern "C" int snn_has_products() {
#ifdef __AVX512F__
    return 1;
#else
    return 0;
#endif
}

#ifdef __AVX512F__
#include <immintrin.h>

namespace {

constexpr long LANES = 64;
constexpr long ROWS = 4;     // of the weights, worked on together
constexpr long CHUNK = 576;  // bits whose tables stay in the first cache
constexpr long SUPER = 32;   // panels that one table serves before the next one is made

// a * 1: half of the additions below are fused multiply-adds, which other units of the processor compute.
inline __m512 ones() {
    __m512 one = _mm512_set1_ps(1.0f);
    asm volatile("" : "+v"(one));  // the compiler shall not see that it is one
    return one;
}

// The 16 sums of every 4 weights of each row: tables [bits / 4][ROWS][16] from a [ROWS][CHUNK].
void make_tables(const float* a, long bits, float* tables) {
    __m512 one = ones();
    for (long k = 0; k < bits; k += 4)
        for (long m = 0; m < ROWS; m++, tables += 16) {
            const float* four = a + m * CHUNK + k;
            __m512 sums = _mm512_maskz_mov_ps(0xAAAA, _mm512_set1_ps(four[0]));
            sums = _mm512_mask3_fmadd_ps(_mm512_set1_ps(four[1]), one, sums, 0xCCCC);
            sums = _mm512_mask_add_ps(sums, 0xF0F0, sums, _mm512_set1_ps(four[2]));
            sums = _mm512_mask3_fmadd_ps(_mm512_set1_ps(four[3]), one, sums, 0xFF00);
            _mm512_store_ps(tables, sums);
        }
}

// sums [ROWS][LANES] = tables . bits of one panel, or more by that.
void add_panel(const float* tables, const uint32_t* panel, long words, float* sums, bool more) {
    constexpr long VECTORS = LANES / 16;
    __m512 one = ones(), total[ROWS][VECTORS];
    for (long m = 0; m < ROWS; m++)
        for (long v = 0; v < VECTORS; v++) total[m][v] = _mm512_setzero_ps();
    for (long w = 0; w < words; w++, panel += LANES) {
        __m512i bits[VECTORS];
        for (long v = 0; v < VECTORS; v++) bits[v] = _mm512_loadu_si512(panel + v * 16);
        for (long g = 0; g < 8; g++) {
            for (long m = 0; m < ROWS; m++, tables += 16) {
                __m512 table = _mm512_load_ps(tables);
                asm("" : "+v"(table));  // kept in its register, not read again for every permutation
                for (long v = 0; v < VECTORS; v++) {
                    __m512 chosen = _mm512_permutexvar_ps(bits[v], table);  // reads the lowest four bits
                    total[m][v] = (m + v) % 2 ? _mm512_add_ps(total[m][v], chosen)
                                              : _mm512_fmadd_ps(chosen, one, total[m][v]);
                }
            }
            for (long v = 0; v < VECTORS; v++) bits[v] = _mm512_srli_epi32(bits[v], 4);
        }
    }
    for (long m = 0; m < ROWS; m++)
        for (long v = 0; v < VECTORS; v++) {
            float* place = sums + m * LANES + v * 16;
            _mm512_store_ps(place, more ? _mm512_add_ps(_mm512_load_ps(place), total[m][v]) : total[m][v]);
        }
}

inline void put4(float* place, __m128 x) { _mm_storeu_ps(place, x); }

inline void put4(BFloat16* place, __m128 x) {  // as put()
    __m128i bits = _mm_castps_si128(x), odd = _mm_and_si128(_mm_srli_epi32(bits, 16), _mm_set1_epi32(1));
    __m128i rounded = _mm_srli_epi32(_mm_add_epi32(bits, _mm_add_epi32(odd, _mm_set1_epi32(0x7fff))), 16);
    __m128i is_nan = _mm_castps_si128(_mm_cmpunord_ps(x, x));
    rounded = _mm_blendv_epi8(rounded, _mm_set1_epi32(0x7fc0), is_nan);
    _mm_storel_epi64((__m128i*)place, _mm_packus_epi32(rounded, rounded));
}

// out[n][m] = sums[m][n] + bias[m] for `lanes` lanes of a panel and `here` rows of `rows` in all.
template <class C>
void put_lanes_first(const float* sums, const float* bias, C* out, long lanes, long here, long rows) {
    if (here < ROWS) {
        for (long n = 0; n < lanes; n++)
            for (long m = 0; m < here; m++) put(out + n * rows + m, sums[m * LANES + n] + bias[m]);
        return;
    }
    __m128 shift = _mm_loadu_ps(bias);
    for (long n = 0; n < lanes; n += 4) {
        __m128 a = _mm_load_ps(sums + n), b = _mm_load_ps(sums + LANES + n), c = _mm_load_ps(sums + 2 * LANES + n),
               d = _mm_load_ps(sums + 3 * LANES + n);
        _MM_TRANSPOSE4_PS(a, b, c, d);
        __m128 columns[4] = {a, b, c, d};
        for (long i = 0; i < std::min(4L, lanes - n); i++) put4(out + (n + i) * rows, _mm_add_ps(columns[i], shift));
    }
}

// Numbers of a large matrix go around the caches, which would read their lines first.
inline void put_row(const float* from, float* to, long lanes, bool is_large) {
    if (!is_large || lanes < LANES || (uintptr_t)to % 64 != 0)
        std::copy(from, from + lanes, to);
    else
        for (long i = 0; i < LANES; i += 16) _mm512_stream_ps(to + i, _mm512_load_ps(from + i));
}

double total(const float* numbers, long count) {  // a multiple of 16
    __m512 sums = _mm512_setzero_ps();
    for (long i = 0; i < count; i += 16) sums = _mm512_add_ps(sums, _mm512_loadu_ps(numbers + i));
    float parts[16];
    _mm512_storeu_ps(parts, sums);
    return std::accumulate(parts, parts + 16, 0.0);
}

// LANES_FIRST: out [N][M] = spikes . a^T + bias of a [M][K]; else out [M][N] = (spikes . a)^T of a [K][M], and bias [M]
// becomes the sums of a over K.
template <bool LANES_FIRST, class A, class C, class B>
void multiply(const A* a, B* bias, const uint32_t* panels, C* out, long M, long K, long N, int threads) {
    long words = (K + 31) / 32, all = (N + LANES - 1) / LANES, blocks = (M + ROWS - 1) / ROWS;
    long supers = std::min(all, std::max((all + SUPER - 1) / SUPER, (threads + blocks - 1) / blocks));
    bool is_large = M * N >= 1 << 20;
#pragma omp parallel num_threads(threads)
    {
        std::vector<float> scratch(CHUNK * ROWS * (1 + 4) + ROWS * LANES * SUPER + 16);
        float* tables = (float*)(((uintptr_t)scratch.data() + 63) / 64 * 64);
        float *sums = tables + CHUNK * ROWS * 4, *some = sums + ROWS * LANES * SUPER;
#pragma omp for schedule(static)
        for (long task = 0; task < supers * blocks; task++) {
            long super = task / blocks, m = task % blocks * ROWS, here = std::min(ROWS, M - m);
            long first = all * super / supers, count = all * (super + 1) / supers - first;
            double whole[ROWS] = {};
            for (long k = 0; k < words * 32; k += CHUNK) {
                long bits = std::min(CHUNK, words * 32 - k), real = std::min(bits, K - k);
                for (long r = 0; r < ROWS; r++)
                    std::fill(some + r * CHUNK + (r < here ? real : 0), some + r * CHUNK + bits, 0.0f);
                for (long r = 0; r < here && LANES_FIRST; r++)
                    for (long i = 0; i < real; i++) some[r * CHUNK + i] = number(a[(m + r) * K + k + i]);
                if (LANES_FIRST && m + 2 * ROWS <= M)
                    for (long r = 0; r < ROWS; r++)
                        for (long i = 0; i < real; i += 64 / sizeof(A)) __builtin_prefetch(a + (m + ROWS + r) * K + k + i);
                for (long i = 0; i < real && !LANES_FIRST; i++)
                    for (long r = 0; r < here; r++) some[r * CHUNK + i] = number(a[(k + i) * M + m + r]);
                for (long r = 0; r < ROWS && !LANES_FIRST; r++)
                    whole[r] += total(some + r * CHUNK, bits);
                make_tables(some, bits, tables);
                for (long p = 0; p < count; p++)
                    add_panel(tables, panels + ((first + p) * words + k / 32) * LANES, bits / 32,
                              sums + p * ROWS * LANES, k > 0);
            }
            if constexpr (!LANES_FIRST)
                if (super == 0) std::copy(whole, whole + here, bias + m);
            for (long p = 0; p < count; p++) {
                const float* from = sums + p * ROWS * LANES;
                long n = (first + p) * LANES, lanes = std::min(LANES, N - n);
                if constexpr (LANES_FIRST)
                    put_lanes_first(from, bias + m, out + n * M + m, lanes, here, M);
                else
                    for (long r = 0; r < here; r++)
                        put_row(from + r * LANES, out + (m + r) * N + n, lanes, is_large);
            }
        }
        _mm_sfence();  // puts what goes around the caches before what follows
    }
}

}  // namespace

extern "C" {

// Panels of what a convolution's windows see: lanes are images times output places, bits are window places times
// channels. spikes [images][height][width][words].
void snn_panels_of_windows(const uint32_t* spikes, uint32_t* panels, long images, long height, long width, long words,
                 long kernel, long stride, int threads) {
    long down = (height - kernel) / stride + 1, across = (width - kernel) / stride + 1;
    long lanes = images * down * across, size = kernel * kernel * words;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long p = 0; p < (lanes + LANES - 1) / LANES; p++) {
        const uint32_t* windows[LANES];
        long count = std::min(LANES, lanes - p * LANES);
        for (long l = 0; l < count; l++) {
            long n = p * LANES + l, image = n / (down * across);
            long y = n / across % down * stride, x = n % across * stride;
            windows[l] = spikes + ((image * height + y) * width + x) * words;
        }
        uint32_t* to = panels + p * size * LANES;
        for (long dy = 0; dy < kernel; dy++)
            for (long i = 0; i < kernel * words; i++, to += LANES) {
                long away = dy * width * words + i;
                for (long l = 0; l < count; l++) to[l] = windows[l][away];
                std::fill(to + count, to + LANES, 0u);
            }
    }
}

// Panels of whole images, one per lane: bit c * places + p. spikes [images][places][words of channels].
void snn_panels_of_images(const uint32_t* spikes, uint32_t* panels, long images, long places, long channels, int threads) {
    long from_words = (channels + 31) / 32, words = (channels * places + 31) / 32, room = (places + 15) / 16 * 16;
#pragma omp parallel num_threads(threads)
    {
        std::vector<uint32_t> column(room);  // one word of every place
#pragma omp for schedule(static)
        for (long lane = 0; lane < (images + LANES - 1) / LANES * LANES; lane++) {
            uint32_t* to = panels + lane / LANES * words * LANES + lane % LANES;
            if (lane >= images) {
                for (long w = 0; w < words; w++) to[w * LANES] = 0;
                continue;
            }
            uint64_t waiting = 0;
            long count = 0;  // bits that wait
            for (long c = 0; c < channels; c++) {
                if (c % 32 == 0)
                    for (long p = 0; p < places; p++)
                        column[p] = spikes[(lane * places + p) * from_words + c / 32];
                __m512i bit = _mm512_set1_epi32(1u << (c % 32));
                for (long p = 0; p < places; p += 16) {
                    __m512i some = _mm512_loadu_si512(column.data() + p);
                    waiting |= uint64_t(_mm512_test_epi32_mask(some, bit)) << count;
                    count += std::min(16L, places - p);
                    if (count >= 32) {
                        *to = uint32_t(waiting);
                        to += LANES, waiting >>= 32, count -= 32;
                    }
                }
            }
            if (count > 0) *to = uint32_t(waiting);
        }
    }
}

// Panels of the transposed matrix: K lanes of N bits.
void snn_transpose_panels(const uint32_t* panels, uint32_t* out, long N, long K, int threads) {
    long words = (K + 31) / 32, all = (N + LANES - 1) / LANES, out_words = (N + 31) / 32;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long q = 0; q < (words + 1) / 2; q++)
        for (long p = 0; p < all; p++)
            for (long half = 0; half < 2; half++) {
                long w = q * 2 + half;
                uint32_t* to = out + (q * out_words + p * 2) * LANES + half * 32;
                const uint32_t* from = panels + (p * words + w) * LANES;
                for (long h = 0; h < std::min(2L, out_words - p * 2); h++) {
                    if (w == words) {
                        std::fill(to + h * LANES, to + h * LANES + 32, 0u);
                        continue;
                    }
                    __m512i low = _mm512_loadu_si512(from + h * 32), high = _mm512_loadu_si512(from + h * 32 + 16);
                    for (long b = 0; b < 32; b++) {
                        __m512i bit = _mm512_set1_epi32(1u << b);
                        to[h * LANES + b] = uint32_t(_mm512_test_epi32_mask(low, bit)) |
                                            uint32_t(_mm512_test_epi32_mask(high, bit)) << 16;
                    }
                }
            }
}

// y [N][M] = spikes [N][K] . a [M][K]^T + bias [M]; both bfloat16 or both floats.
void snn_multiply(const void* a, int is_bf16, const float* bias, const uint32_t* panels, void* y, long M, long K, long N,
                  int threads) {
    if (is_bf16)
        multiply<true>((const BFloat16*)a, bias, panels, (BFloat16*)y, M, K, N, threads);
    else
        multiply<true>((const float*)a, bias, panels, (float*)y, M, K, N, threads);
}

// out [M][N] = a [K][M]^T . spikes [N][K]^T, and the sums [M] of a over K, in floats.
void snn_multiply_transposed(const void* a, int is_bf16, const uint32_t* panels, float* out, float* sums, long M, long K,
                             long N, int threads) {
    if (is_bf16)
        multiply<false>((const BFloat16*)a, sums, panels, out, M, K, N, threads);
    else
        multiply<false>((const float*)a, sums, panels, out, M, K, N, threads);
}
}
#endif
