// float and bfloat16 numbers, one and sixteen at a time.

#pragma once

#include <cstdint>
#include <cstring>

#ifdef __AVX512F__
#include <immintrin.h>
#endif

struct BFloat16 {
    uint16_t bits;
};

inline float number(float x) { return x; }

inline float number(BFloat16 x) {
    uint32_t bits = uint32_t(x.bits) << 16;
    float value;
    std::memcpy(&value, &bits, 4);
    return value;
}

inline void put(float* place, float x) { *place = x; }

inline void put(BFloat16* place, float x) {  // to the nearest, ties to even; not a number stays so
    uint32_t bits;
    std::memcpy(&bits, &x, 4);
    uint32_t rounded = (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;
    place->bits = uint16_t(x != x ? 0x7fc0u : rounded);
}

constexpr long WIDTH = 16;
typedef float Lanes __attribute__((vector_size(4 * WIDTH)));
typedef int32_t Flags __attribute__((vector_size(4 * WIDTH)));  // all bits of a lane, or none
typedef uint32_t Words __attribute__((vector_size(4 * WIDTH)));
typedef uint16_t Halves __attribute__((vector_size(2 * WIDTH)));

// Lengthened and shortened in one instruction; compilers take four for __builtin_convertvector.
inline Words widen(Halves x) {
#ifdef __AVX512F__
    return (Words)_mm512_cvtepu16_epi32((__m256i)x);
#else
    return __builtin_convertvector(x, Words);
#endif
}

inline Halves narrow(Words x) {
#ifdef __AVX512F__
    return (Halves)_mm512_cvtepi32_epi16((__m512i)x);
#else
    return __builtin_convertvector(x, Halves);
#endif
}

inline Lanes same(float x) { return Lanes{} + x; }

// Of fewer than WIDTH numbers, the other lanes are 0 when they are read, and not written.
inline Lanes load(const float* place, long width) {
    Lanes x = {};
    if (width == WIDTH)
        std::memcpy(&x, place, sizeof x);
    else
        std::memcpy(&x, place, width * sizeof *place);
    return x;
}

inline Lanes load(const BFloat16* place, long width) {
    Halves x = {};
    if (width == WIDTH)
        std::memcpy(&x, place, sizeof x);
    else
        std::memcpy(&x, place, width * sizeof *place);
    return (Lanes)(widen(x) << 16);
}

inline void store(float* place, Lanes x, long width) {
    if (width == WIDTH)
        std::memcpy(place, &x, sizeof x);
    else
        std::memcpy(place, &x, width * sizeof *place);
}

inline void store(BFloat16* place, Lanes x, long width) {  // as put()
    Words bits = (Words)x, rounded = (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;
    Halves halves = narrow(x != x ? Words{} + 0x7fc0u : rounded);
    if (width == WIDTH)
        std::memcpy(place, &halves, sizeof halves);
    else
        std::memcpy(place, &halves, width * sizeof *place);
}
