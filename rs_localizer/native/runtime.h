/* Copyright 2026 rs_localizer contributors
   SPDX-License-Identifier: Apache-2.0 */
#ifndef RS_LOCALIZER_RUNTIME_H
#define RS_LOCALIZER_RUNTIME_H
#include "abi3.h"

/* A kernel: writes its result, or its error, and takes its arguments from 64-bit slots. */
typedef int Thunk(void *result, void **error, int64_t *slots);

/* A named tuple; imported when it first occurs. */
typedef struct {
    const char *module, *name;
    PyObject *type;
} Class;

/* What rs_localizer.native.bitcode writes: see declared.encode for the texts. */
typedef struct {
    const char *name, *arguments;
    int count;
    const char *result;
    Thunk *thunk;
} Entry;

extern Class CLASSES[];
extern const Entry ENTRIES[];
#endif
