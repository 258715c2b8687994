/* Copyright 2026 rs_localizer contributors
   SPDX-License-Identifier: Apache-2.0

   From Python to kernels and back, in the limited API of Python 3.11; and what kernels want of
   Numba: memory with counted references. */
#include "runtime.h"

#include <stdlib.h>
#include <string.h>

#define HIDDEN __attribute__((visibility("hidden")))
/* As in bitcode.py, which refuses entries that need more. */
#define MOST_SLOTS 512
#define MOST_RESULT 2048
#define MOST_ARRAYS 64
#define MOST_DIMENSIONS 8

/* -- memory, as Numba's run time lays it out (numba/core/runtime/nrt.cpp) --------------------- */

typedef struct {
    size_t references;
    void (*destroy)(void *, size_t, void *);
    void *destroy_info;
    void *data;
    size_t size;
    void *external;
} MemInfo;

HIDDEN void NRT_MemInfo_call_dtor(MemInfo *info) {
    if (info->destroy) info->destroy(info->data, info->size, info->destroy_info);
    free(info);
}
HIDDEN void NRT_incref(MemInfo *info) {
    if (info) __atomic_fetch_add(&info->references, 1, __ATOMIC_RELAXED);
}
HIDDEN void NRT_decref(MemInfo *info) {
    if (info && __atomic_fetch_sub(&info->references, 1, __ATOMIC_ACQ_REL) == 1)
        NRT_MemInfo_call_dtor(info);
}
HIDDEN MemInfo *NRT_MemInfo_alloc_aligned(size_t size, unsigned align) {
    MemInfo *info = malloc(sizeof(MemInfo) + size + 2 * (size_t)align);
    if (!info) return NULL;
    char *base = (char *)(info + 1);
    size_t over = align ? (uintptr_t)base % align : 0;
    if (over) base += align - over;
    *info = (MemInfo){1, NULL, NULL, base, size, NULL};
    return info;
}
HIDDEN MemInfo *NRT_MemInfo_alloc_safe_aligned(size_t size, unsigned align) {
    return NRT_MemInfo_alloc_aligned(size, align);
}
HIDDEN MemInfo *NRT_MemInfo_alloc_aligned_external(size_t size, unsigned align, void *allocator) {
    (void)allocator;
    return NRT_MemInfo_alloc_aligned(size, align);
}
HIDDEN MemInfo *NRT_MemInfo_alloc_safe_aligned_external(size_t size, unsigned align, void *allocator) {
    (void)allocator;
    return NRT_MemInfo_alloc_aligned(size, align);
}
HIDDEN MemInfo *NRT_MemInfo_alloc(size_t size) { return NRT_MemInfo_alloc_aligned(size, 64); }
HIDDEN void *NRT_MemInfo_data_fast(MemInfo *info) { return info->data; }
HIDDEN void *NRT_Allocate(size_t size) { return malloc(size); }
HIDDEN void *NRT_Allocate_External(size_t size, void *allocator) {
    (void)allocator;
    return malloc(size);
}
HIDDEN void NRT_Free(void *memory) { free(memory); }
static void free_data(void *data, size_t size, void *destroy) {
    (void)size;
    if (destroy) ((void (*)(void *))destroy)(data);
    free(data);
}
HIDDEN MemInfo *NRT_MemInfo_new_varsize_dtor(size_t size, void *destroy) {
    MemInfo *info = malloc(sizeof *info);
    void *data = malloc(size);
    if (!info || !data) {
        free(info);
        free(data);
        return NULL;
    }
    *info = (MemInfo){1, free_data, destroy, data, size, NULL};
    return info;
}
HIDDEN void *NRT_MemInfo_varsize_realloc(MemInfo *info, size_t size) {
    void *data = realloc(info->data, size);
    if (data) {
        info->data = data;
        info->size = size;
    }
    return data;
}
/* operator new, which Eigen calls where malloc has no memory, so that it throws: nothing else is of
   the library of C++, which is not linked. */
HIDDEN void *without_memory(size_t size) __asm__("_Znwm");
void *without_memory(size_t size) {
    (void)size;
    abort();
}
HIDDEN void numba_fatal_error(void) { Py_FatalError("a kernel failed"); }
HIDDEN void numba_gil_ensure(int *state) { *state = PyGILState_Ensure(); }
HIDDEN void numba_gil_release(int *state) { PyGILState_Release(*state); }
/* Of errors whose text a kernel makes: none does. This one is of no stable ABI. */
HIDDEN PyObject *PyUnicode_FromKindAndData(int kind, const void *data, Py_ssize_t size) {
    (void)kind, (void)data, (void)size;
    return NULL;
}
HIDDEN void *numba_unpickle(const char *data, int size, const char *hash) {
    (void)data, (void)size, (void)hash;
    return NULL;
}
HIDDEN int numba_do_raise(void *error) {
    (void)error;
    return 0;
}
HIDDEN void *numba_runtime_build_excinfo_struct(void *info, void *arguments) {
    (void)info, (void)arguments;
    return NULL;
}
/* Contiguous arrays take another shape where they are. */
HIDDEN int numba_attempt_nocopy_reshape(
    intptr_t count, const intptr_t *shape, const intptr_t *strides, intptr_t new_count,
    const intptr_t *new_shape, intptr_t *new_strides, intptr_t item, int is_fortran) {
    intptr_t step = item;
    for (intptr_t i = count - 1; i >= 0; --i) {
        if (shape[i] != 1 && strides[i] != step) return 0;
        step *= shape[i];
    }
    if (is_fortran) return 0;
    step = item;
    for (intptr_t i = new_count - 1; i >= 0; --i) {
        new_strides[i] = step;
        step *= new_shape[i];
    }
    return 1;
}

/* -- arguments --------------------------------------------------------------------------------- */

static PyObject *ndarray, *numpy_empty, *numpy_bool, *numpy_int64, *dtypes[128], *refuse;

typedef struct {
    int64_t slots[MOST_SLOTS];
    int used;
    Py_buffer views[MOST_ARRAYS];
    int count;
} Call;

static void end_call(Call *call) {
    while (call->count > 0) PyBuffer_Release(&call->views[--call->count]);
}
static int two_digits(const char *text) { return 10 * (text[0] - '0') + text[1] - '0'; }

static PyObject *class_at(int number) {
    Class *it = &CLASSES[number];
    if (!it->type) {
        PyObject *module = PyImport_ImportModule(it->module);
        if (!module) return NULL;
        it->type = PyObject_GetAttrString(module, it->name);
        Py_DecRef(module);
    }
    return it->type;
}

/* The buffer protocol's letters of 64-bit integers differ by platform. */
static int is_format(const char *format, char code) {
    if (!format || format[1]) return 0;
    if (code == 'q') return format[0] == 'q' || (sizeof(long) == 8 && format[0] == 'l');
    if (code == 'Q') return format[0] == 'Q' || (sizeof(long) == 8 && format[0] == 'L');
    return format[0] == code;
}

static int take_array(Call *call, PyObject *value, const char *kind) {
    if (!PyType_IsSubtype(Py_TYPE(value), (PyTypeObject *)ndarray) || call->count == MOST_ARRAYS) return 0;
    Py_buffer *view = &call->views[call->count];
    int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (kind[0] == 'w' ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(value, view, flags) < 0) {
        PyErr_Clear();
        return 0;
    }
    ++call->count;
    int dimensions = kind[2] - '0';
    if (view->ndim != dimensions || !is_format(view->format, kind[1]) ||
        (uintptr_t)view->buf % (size_t)view->itemsize)
        return 0;
    int64_t *slot = call->slots + call->used;
    *slot++ = 0; /* no memory of Numba's, and no owner: kernels keep nothing */
    *slot++ = 0;
    *slot++ = view->len / view->itemsize;
    *slot++ = view->itemsize;
    *slot++ = (int64_t)(intptr_t)view->buf;
    for (int i = 0; i < dimensions; ++i) *slot++ = view->shape[i];
    for (int i = 0; i < dimensions; ++i) *slot++ = view->strides[i];
    call->used += 5 + 2 * dimensions;
    return 1;
}

static int take_scalar(Call *call, PyObject *value, char code) {
    int64_t *slot = call->slots + call->used++;
    if (code == 'd') {
        if (!PyType_IsSubtype(Py_TYPE(value), &PyFloat_Type)) return 0; /* np.float64 is one */
        double number = PyFloat_AsDouble(value);
        memcpy(slot, &number, sizeof number);
        return 1;
    }
    if (code == '?') {
        if (Py_TYPE(value) != &PyBool_Type && (PyObject *)Py_TYPE(value) != numpy_bool) return 0;
        *slot = PyObject_IsTrue(value);
        return 1;
    }
    if (Py_TYPE(value) == &PyBool_Type) return 0;
    if (!PyType_IsSubtype(Py_TYPE(value), &PyLong_Type) && (PyObject *)Py_TYPE(value) != numpy_int64)
        return 0;
    PyObject *number = PyNumber_Index(value);
    *slot = number ? PyLong_AsLongLong(number) : -1;
    Py_DecRef(number);
    if (*slot == -1 && PyErr_Occurred()) {
        PyErr_Clear();
        return 0;
    }
    return 1;
}

/* Take one argument; moves on in the text that says what it is. */
static int take(Call *call, PyObject *value, const char **text) {
    const char *kind = *text;
    if (kind[0] == 'r' || kind[0] == 'w') {
        *text += 3;
        return take_array(call, value, kind);
    }
    if (kind[0] != 't') {
        *text += 1;
        return take_scalar(call, value, kind[0]);
    }
    int number = two_digits(kind + 1), count = two_digits(kind + 3);
    PyObject *wanted = number == 99 ? (PyObject *)&PyTuple_Type : class_at(number);
    if ((PyObject *)Py_TYPE(value) != wanted || PyTuple_Size(value) != count) return 0;
    *text += 5;
    for (int i = 0; i < count; ++i)
        if (!take(call, PyTuple_GetItem(value, i), text)) return 0;
    return 1;
}

/* -- results ----------------------------------------------------------------------------------- */

typedef struct {
    MemInfo *info;
    void *owner;
    int64_t items, itemsize;
    char *data;
    int64_t sizes[]; /* shape, then strides */
} Array;

/* Copy what is at strides into what is contiguous. */
static char *copied(char *to, const char *from, const int64_t *sizes, int dimensions, int left,
                    size_t item) {
    if (left == 0) {
        memcpy(to, from, item);
        return to + item;
    }
    int axis = dimensions - left;
    for (int64_t i = 0; i < sizes[axis]; ++i)
        to = copied(to, from + i * sizes[dimensions + axis], sizes, dimensions, left - 1, item);
    return to;
}

static PyObject *give_array(const Array *array, char code, int dimensions) {
    PyObject *shape = PyTuple_New(dimensions);
    for (int i = 0; shape && i < dimensions; ++i)
        PyTuple_SetItem(shape, i, PyLong_FromLongLong(array->sizes[i]));
    PyObject *made = shape ? PyObject_CallFunctionObjArgs(numpy_empty, shape, dtypes[(int)code], NULL)
                           : NULL;
    Py_DecRef(shape);
    Py_buffer view;
    if (made && PyObject_GetBuffer(made, &view, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) == 0) {
        int64_t step = array->itemsize;
        int whole = 1;
        for (int i = dimensions - 1; i >= 0; --i) {
            whole = whole && (array->sizes[i] == 1 || array->sizes[dimensions + i] == step);
            step *= array->sizes[i];
        }
        if (view.len > 0) {
            if (whole) memcpy(view.buf, array->data, (size_t)view.len);
            else copied(view.buf, array->data, array->sizes, dimensions, dimensions, (size_t)array->itemsize);
        }
        PyBuffer_Release(&view);
    } else {
        Py_DecRef(made);
        made = NULL;
    }
    NRT_decref(array->info);
    return made;
}

static int four_digits(const char *text) { return 100 * two_digits(text) + two_digits(text + 2); }

/* Give one part of a result. After an error it still goes through all parts, to free them. */
static PyObject *give(const char *result, const char **text) {
    const char *kind = *text;
    if (kind[0] == 'n') {
        *text += 1;
        return Py_NewRef(Py_None);
    }
    if (kind[0] == 'r') {
        *text += 7;
        return give_array((const Array *)(result + four_digits(kind + 3)), kind[1], kind[2] - '0');
    }
    if (kind[0] == 't') {
        int number = two_digits(kind + 1), count = two_digits(kind + 3), is_whole = 1;
        *text += 5;
        PyObject *items = PyTuple_New(count);
        for (int i = 0; i < count; ++i) {
            PyObject *item = give(result, text);
            is_whole = is_whole && item;
            if (items) PyTuple_SetItem(items, i, item);
            else Py_DecRef(item);
        }
        if (!items || !is_whole) {
            Py_DecRef(items);
            return NULL;
        }
        if (number == 99) return items;
        PyObject *named = class_at(number), *made = NULL, *arguments = PyTuple_Pack(1, items);
        newfunc make = (newfunc)PyType_GetSlot(&PyTuple_Type, Py_tp_new);
        if (named && arguments) made = make((PyTypeObject *)named, arguments, NULL);
        Py_DecRef(arguments);
        Py_DecRef(items);
        return made;
    }
    *text += 5;
    const char *at = result + four_digits(kind + 1);
    if (kind[0] == '?') return PyBool_FromLong(*at);
    if (kind[0] == 'q') {
        int64_t number;
        memcpy(&number, at, sizeof number);
        return PyLong_FromLongLong(number);
    }
    double number;
    memcpy(&number, at, sizeof number);
    return PyFloat_FromDouble(number);
}

/* The error that a kernel raised: its class and arguments are in the module, pickled by Numba. */
static PyObject *failed(int code, const void *error, const char *name) {
    const struct {
        const char *data;
        int32_t size;
    } *raised = error;
    if (code == -1 || !raised) {
        if (!PyErr_Occurred()) PyErr_Format(PyExc_SystemError, "%s failed (%d)", name, code);
        return NULL;
    }
    PyObject *pickle = PyImport_ImportModule("pickle"), *both = NULL;
    if (pickle)
        both = PyObject_CallMethod(pickle, "loads", "N",
                                   PyBytes_FromStringAndSize(raised->data, raised->size));
    Py_DecRef(pickle);
    if (both && PyType_IsSubtype(Py_TYPE(both), &PyTuple_Type) && PyTuple_Size(both) >= 2)
        PyErr_SetObject(PyTuple_GetItem(both, 0), PyTuple_GetItem(both, 1));
    else if (!PyErr_Occurred())
        PyErr_Format(PyExc_SystemError, "%s failed (%d)", name, code);
    Py_DecRef(both);
    return NULL;
}

/* -- entries ----------------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    const Entry *entry;
} Bound;

static PyObject *call(PyObject *self, PyObject *const *arguments, Py_ssize_t count) {
    const Entry *entry = ((Bound *)self)->entry;
    Call taken;
    taken.used = taken.count = 0;
    const char *text = entry->arguments;
    int fits = count == entry->count;
    for (Py_ssize_t i = 0; fits && i < count; ++i) fits = take(&taken, arguments[i], &text);
    if (!fits) {
        end_call(&taken);
        if (PyErr_Occurred()) return NULL;
        PyObject *given = PyTuple_New(count), *said = NULL;
        for (Py_ssize_t i = 0; given && i < count; ++i)
            PyTuple_SetItem(given, i, Py_NewRef(arguments[i]));
        if (given) said = PyObject_CallFunction(refuse, "sO", entry->name, given);
        Py_DecRef(given);
        return said;
    }
    _Alignas(16) char result[MOST_RESULT];
    void *error = NULL;
    PyThreadState *state = PyEval_SaveThread();
    int code = entry->thunk(result, &error, taken.slots);
    PyEval_RestoreThread(state);
    PyObject *given;
    if (code == 0 || code == -2) { /* -2: None */
        text = entry->result;
        given = give(result, &text);
    } else given = failed(code, error, entry->name);
    end_call(&taken);
    return given;
}

static PyObject *reduce(PyObject *self, PyObject *unused) {
    (void)unused;
    PyObject *native = PyImport_ImportModule("rs_localizer.native"), *found;
    if (!native) return NULL;
    found = PyObject_GetAttrString(native, "bound");
    Py_DecRef(native);
    return found ? Py_BuildValue("N(s)", found, ((Bound *)self)->entry->name) : NULL;
}
static PyObject *represent(PyObject *self) {
    return PyUnicode_FromFormat("<kernel %s>", ((Bound *)self)->entry->name);
}
static void destroy(PyObject *self) {
    PyTypeObject *type = Py_TYPE(self);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DecRef((PyObject *)type);
}
static PyMethodDef bound_methods[] = {
    {"call", (PyCFunction)(void (*)(void))call, METH_FASTCALL, "Run the kernel."},
    {"__reduce__", reduce, METH_NOARGS, "Find the kernel by its name where it is unpickled."},
    {NULL, NULL, 0, NULL},
};
static PyType_Slot bound_slots[] = {
    {Py_tp_methods, bound_methods},
    {Py_tp_repr, represent},
    {Py_tp_dealloc, destroy},
    {0, NULL},
};
static PyType_Spec bound_spec = {
    "rs_localizer.native.Entry", sizeof(Bound), 0, Py_TPFLAGS_DEFAULT, bound_slots,
};
static PyObject *bound_type;

static PyObject *bound(PyObject *self, PyObject *name) {
    (void)self;
    const char *wanted = PyUnicode_AsUTF8AndSize(name, NULL);
    if (!wanted) return NULL;
    for (const Entry *entry = ENTRIES; entry->name; ++entry)
        if (!strcmp(entry->name, wanted)) {
            allocfunc make = (allocfunc)PyType_GetSlot((PyTypeObject *)bound_type, Py_tp_alloc);
            Bound *made = (Bound *)make((PyTypeObject *)bound_type, 0);
            if (made) made->entry = entry;
            return (PyObject *)made;
        }
    return PyErr_Format(PyExc_LookupError, "%s has not been compiled", wanted);
}

static PyMethodDef module_methods[] = {
    {"bound", bound, METH_O, "The entry of that name; its method ``call`` runs the kernel."},
    {NULL, NULL, 0, NULL},
};

static int prepare(PyObject *module) {
    PyObject *numpy = PyImport_ImportModule("numpy");
    PyObject *native = PyImport_ImportModule("rs_localizer.native.declared");
    if (!numpy || !native) return -1;
    ndarray = PyObject_GetAttrString(numpy, "ndarray");
    numpy_empty = PyObject_GetAttrString(numpy, "empty");
    numpy_bool = PyObject_GetAttrString(numpy, "bool_");
    numpy_int64 = PyObject_GetAttrString(numpy, "int64");
    refuse = PyObject_GetAttrString(native, "refuse_call");
    for (const char *code = "dq?BQf"; *code; ++code) {
        const char text[2] = {*code, 0};
        dtypes[(int)*code] = PyObject_CallMethod(numpy, "dtype", "s", text);
        if (!dtypes[(int)*code]) return -1;
    }
    bound_type = PyType_FromSpec(&bound_spec);
    Py_DecRef(numpy);
    Py_DecRef(native);
    if (!ndarray || !numpy_empty || !numpy_bool || !numpy_int64 || !refuse || !bound_type) return -1;
    return PyModule_AddStringConstant(module, "LEVEL", RS_LEVEL);
}
static PyModuleDef_Slot slots[] = {{Py_mod_exec, prepare}, {0, NULL}};
static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_kernels", "Kernels of one level.", 0, module_methods, slots, NULL, NULL, NULL,
};
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
PyMODINIT_FUNC JOIN(PyInit__kernels_, RS_LEVEL_NAME)(void) { return PyModuleDef_Init(&definition); }
