/* What all of these share. */
#ifndef DJET_COMMON_H
#define DJET_COMMON_H

#include <math.h>
#include <stdint.h>

/* Of functions that are worth it there are two, and the machine takes what it can. Neither sums up
   in another order, nor rounds otherwise. */
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
