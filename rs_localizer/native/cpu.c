/* Copyright 2026 rs_localizer contributors
   SPDX-License-Identifier: Apache-2.0

   The level of this processor, by what it and the operating system say: compiled for any x86-64,
   so that it runs where no kernel does. Bits: Intel's manual, volume 2, CPUID and XGETBV; levels:
   the x86-64 psABI. */
#include "abi3.h"

#include <cpuid.h>

static int has(uint32_t word, uint32_t bits) { return (word & bits) == bits; }

static uint64_t saved_registers(void) {
    uint32_t low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return (uint64_t)high << 32 | low;
}

static const char *level_of(void) {
    uint32_t a, b, c, d, extended;
    if (!__get_cpuid(1, &a, &b, &c, &d)) return "none";
    /* SSE3, SSSE3, CMPXCHG16B, SSE4.1, SSE4.2, POPCNT */
    if (!has(c, 1u << 0 | 1u << 9 | 1u << 13 | 1u << 19 | 1u << 20 | 1u << 23)) return "none";
    /* FMA, MOVBE, OSXSAVE, AVX, F16C */
    if (!has(c, 1u << 12 | 1u << 22 | 1u << 27 | 1u << 28 | 1u << 29)) return "v2";
    uint64_t saved = saved_registers();
    if ((saved & 0x6) != 0x6) return "v2"; /* SSE and AVX */
    if (!__get_cpuid(0x80000001u, &a, &b, &extended, &d) || !has(extended, 1u << 5)) return "v2"; /* LZCNT */
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return "v2";
    if (!has(b, 1u << 3 | 1u << 5 | 1u << 8)) return "v2"; /* BMI1, AVX2, BMI2 */
    /* AVX512 F, DQ, CD, BW, VL; opmask and both halves of ZMM */
    if (!has(b, 1u << 16 | 1u << 17 | 1u << 28 | 1u << 30 | 1u << 31)) return "v3";
    return (saved & 0xe6) == 0xe6 ? "v4" : "v3";
}

static PyObject *level(PyObject *self, PyObject *unused) {
    (void)self, (void)unused;
    return PyUnicode_FromString(level_of());
}
static PyMethodDef methods[] = {
    {"level", level, METH_NOARGS, "The level of this processor: none, v2, v3 or v4."},
    {NULL, NULL, 0, NULL},
};
static PyModuleDef_Slot slots[] = {{0, NULL}};
static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_cpu", "The level of this processor.", 0, methods, slots, NULL, NULL, NULL,
};
PyMODINIT_FUNC PyInit__cpu(void) { return PyModuleDef_Init(&definition); }
