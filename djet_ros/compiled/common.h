/* Definitions common to all files. */
#ifndef DJET_COMMON_H
#define DJET_COMMON_H

#include <math.h>
#include <stdint.h>

/* Functions built twice, the second time for AVX2, selected at run time. Both sum in the same
   order and round alike. */
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#endif
