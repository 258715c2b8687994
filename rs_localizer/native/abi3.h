/* Copyright 2026 rs_localizer contributors
   SPDX-License-Identifier: Apache-2.0

   What runtime.c and cpu.c use of Python's stable ABI ("abi3"), as it is since Python 3.11: so that
   a build needs no headers of Python, neither of this machine nor of the one that it builds for.
   The numbers and layouts are fixed by PEP 384 and PEP 688; test/native holds them against Python.h
   where that is installed. */
#ifndef RS_LOCALIZER_ABI3_H
#define RS_LOCALIZER_ABI3_H
#include <stddef.h>
#include <stdint.h>

typedef intptr_t Py_ssize_t;
typedef struct _object PyObject;
typedef struct _typeobject PyTypeObject;
typedef struct _ts PyThreadState;

struct _object {
    Py_ssize_t references;
    PyTypeObject *type;
};
#define PyObject_HEAD PyObject ob_base;

typedef PyObject *(*PyCFunction)(PyObject *, PyObject *);
typedef PyObject *(*newfunc)(PyTypeObject *, PyObject *, PyObject *);
typedef PyObject *(*allocfunc)(PyTypeObject *, Py_ssize_t);
typedef void (*freefunc)(void *);

typedef struct {
    const char *ml_name;
    PyCFunction ml_meth;
    int ml_flags;
    const char *ml_doc;
} PyMethodDef;
#define METH_NOARGS 0x0004
#define METH_O 0x0008
#define METH_FASTCALL 0x0080

typedef struct {
    int slot;
    void *pfunc;
} PyType_Slot;
typedef struct {
    const char *name;
    int basicsize, itemsize;
    unsigned flags;
    PyType_Slot *slots;
} PyType_Spec;
#define Py_tp_alloc 47
#define Py_tp_dealloc 52
#define Py_tp_methods 64
#define Py_tp_new 65
#define Py_tp_repr 66
#define Py_tp_free 74
#define Py_TPFLAGS_DEFAULT 0

typedef struct {
    int slot;
    void *value;
} PyModuleDef_Slot;
#define Py_mod_exec 2
typedef struct {
    PyObject ob_base;
    PyObject *(*m_init)(void);
    Py_ssize_t m_index;
    PyObject *m_copy;
    const char *m_name, *m_doc;
    Py_ssize_t m_size;
    PyMethodDef *m_methods;
    PyModuleDef_Slot *m_slots;
    void *m_traverse, *m_clear, *m_free;
} PyModuleDef;
#define PyModuleDef_HEAD_INIT {1, NULL}, NULL, 0, NULL
#define PyMODINIT_FUNC __attribute__((visibility("default"))) PyObject *

typedef struct {
    void *buf;
    PyObject *obj;
    Py_ssize_t len, itemsize;
    int readonly, ndim;
    char *format;
    Py_ssize_t *shape, *strides, *suboffsets;
    void *internal;
} Py_buffer;
#define PyBUF_WRITABLE 0x0001
#define PyBUF_FORMAT 0x0004
#define PyBUF_C_CONTIGUOUS 0x0038

extern PyTypeObject PyTuple_Type, PyFloat_Type, PyBool_Type, PyLong_Type;
extern PyObject *PyExc_SystemError, *PyExc_LookupError;
extern PyObject _Py_NoneStruct, _Py_TrueStruct, _Py_FalseStruct;
#define Py_None (&_Py_NoneStruct)
#define Py_TYPE(object) ((object)->type)

void Py_IncRef(PyObject *), Py_DecRef(PyObject *); /* both take NULL */
PyObject *Py_NewRef(PyObject *);
int PyType_IsSubtype(PyTypeObject *, PyTypeObject *);
void *PyType_GetSlot(PyTypeObject *, int);
PyObject *PyType_FromSpec(PyType_Spec *);
PyObject *PyObject_GetAttrString(PyObject *, const char *);
PyObject *PyObject_CallFunctionObjArgs(PyObject *, ...);
PyObject *PyObject_CallFunction(PyObject *, const char *, ...);
PyObject *PyObject_CallMethod(PyObject *, const char *, const char *, ...);
int PyObject_IsTrue(PyObject *);
int PyObject_GetBuffer(PyObject *, Py_buffer *, int);
void PyBuffer_Release(Py_buffer *);
PyObject *PyBytes_FromStringAndSize(const char *, Py_ssize_t);
PyObject *PyTuple_New(Py_ssize_t), *PyTuple_Pack(Py_ssize_t, ...);
PyObject *PyTuple_GetItem(PyObject *, Py_ssize_t);
int PyTuple_SetItem(PyObject *, Py_ssize_t, PyObject *);
Py_ssize_t PyTuple_Size(PyObject *);
double PyFloat_AsDouble(PyObject *);
PyObject *PyFloat_FromDouble(double), *PyBool_FromLong(long);
PyObject *PyLong_FromLongLong(long long), *PyNumber_Index(PyObject *);
long long PyLong_AsLongLong(PyObject *);
const char *PyUnicode_AsUTF8AndSize(PyObject *, Py_ssize_t *);
PyObject *PyUnicode_FromFormat(const char *, ...), *PyUnicode_FromString(const char *);
PyObject *Py_BuildValue(const char *, ...);
PyObject *PyImport_ImportModule(const char *);
int PyModule_AddStringConstant(PyObject *, const char *, const char *);
PyObject *PyModuleDef_Init(PyModuleDef *);
PyObject *PyErr_Occurred(void), *PyErr_Format(PyObject *, const char *, ...);
void PyErr_Clear(void), PyErr_SetObject(PyObject *, PyObject *);
PyThreadState *PyEval_SaveThread(void);
void PyEval_RestoreThread(PyThreadState *);
int PyGILState_Ensure(void);
void PyGILState_Release(int), Py_FatalError(const char *);
#endif
