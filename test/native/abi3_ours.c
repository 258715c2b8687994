#include "abi3.h"

typedef struct { PyObject_HEAD void *end; } OfHead;
static const size_t ours[] = {
    sizeof(PyObject), sizeof(PyMethodDef), sizeof(PyType_Slot), sizeof(PyType_Spec),
    sizeof(PyModuleDef), sizeof(PyModuleDef_Slot), sizeof(Py_buffer), offsetof(Py_buffer, len),
    offsetof(Py_buffer, ndim), offsetof(Py_buffer, format), offsetof(Py_buffer, shape),
    offsetof(PyModuleDef, m_name), offsetof(PyModuleDef, m_slots), offsetof(PyType_Spec, flags),
    offsetof(PyType_Spec, slots), offsetof(PyMethodDef, ml_flags), offsetof(OfHead, end),
};
size_t our(int i) { return ours[i]; }
int our_number(int i) {
    static const int numbers[] = {
        Py_tp_alloc, Py_tp_dealloc, Py_tp_methods, Py_tp_new, Py_tp_repr, Py_tp_free, Py_mod_exec,
        METH_NOARGS, METH_O, METH_FASTCALL, PyBUF_WRITABLE, PyBUF_FORMAT, PyBUF_C_CONTIGUOUS,
    };
    return numbers[i];
}
